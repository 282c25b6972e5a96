"""The result of a run: its agent and the baselines in one table, notes on it, and its files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from armscan.agents.baselines import RandomAgent
from armscan.experiment.build import RunSetup
from armscan.reports.html import page
from armscan.training import (
    TEST,
    TRAINING,
    VALIDATION,
    Evaluation,
    MetricEstimates,
    ResultTable,
    TrainingResult,
    evaluate,
    evaluate_baselines,
)
from armscan.training.baselines import AGENT, RANDOM
from armscan.training.episode_results import TEST_METRICS, metric_prefix
from armscan.training.episode_seeds import TEST_VOLUMES_SEED, TRAINING_VOLUMES_SEED
from armscan.training.headline import ABOVE_RANDOM, MIN_SUBJECTS, beside_random, headline
from armscan.training.metric_display import LEADING
from armscan.utils.files import atomic_write
from armscan.utils.run_files import BASELINES_FILE, EVALUATION_FILE, RESULTS_PAGE
from armscan.utils.text import PERCENT, counted, formatted

LAST_VALIDATION, BEST_VALIDATION, NEW_EPISODES = "last validation", "best validation", "new validation episodes"
TITLES = {
    TEST: "agent, test",
    # Of the epoch that has the best one: see `docs/metrics.md`.
    VALIDATION: f"agent, {BEST_VALIDATION}",
    LAST_VALIDATION: f"agent, {LAST_VALIDATION}",
    BEST_VALIDATION: f"agent, {BEST_VALIDATION}",
    NEW_EPISODES: f"agent, {NEW_EPISODES}",
    TRAINING: "agent, training",
}
# Every evaluation tracks this metric, below the name of its group; `NAMES` maps groups to the names of their volumes.
EVALUATED = "/success_rate"
# Of the metrics of a single volume in an evaluation.
VOLUME_PREFIX = "volume/"
NAMES = {metric_prefix(name): name for name in (TEST, TRAINING)} | {
    "validation": LAST_VALIDATION,
    "selection": NEW_EPISODES,
}
# Groups of metrics that are no evaluation, or that a trial also has by the names of runs.
LEFT_OUT = ("train", "test")


@dataclass(frozen=True)
class RunResult:
    """Results of a run.

    Args:
        evaluations: Final evaluations of the agent, by the names of their volumes.
        baselines: Episodes of the baselines on the test volumes, by their names.
        validation: Validation of the best epoch; None for an agent that does not learn.
        own_baseline: Name of the baseline that equals the agent. Default: None, no baseline does.
        weights_note: Note on the weights, if the agent has one. Default: None.
    """

    evaluations: Mapping[str, Evaluation]
    baselines: Mapping[str, Evaluation]
    validation: Evaluation | None = None
    own_baseline: str | None = None
    weights_note: str | None = None

    @classmethod
    def of(cls, setup: RunSetup, result: TrainingResult | None) -> RunResult:
        """Play the final evaluations of a setup's agent, and the baselines on its test volumes.

        Args:
            setup: Setup of the run, whose agent has the weights to evaluate.
            result: Result of the training; None for an agent that does not learn.
        """
        agent, seed, n_episodes, on_plane = setup.agent, setup.seed, setup.n_episodes, setup.on_plane
        first_seeds = {TRAINING: TRAINING_VOLUMES_SEED + seed, TEST: TEST_VOLUMES_SEED + seed}
        envs = {TRAINING: setup.training_env, TEST: setup.test_env}
        evaluations = {
            name: evaluate(agent, envs[name], n_episodes=n_episodes, seed=first, on_plane=on_plane)
            for name, first in first_seeds.items()
        }
        baselines = evaluate_baselines(setup.test_env, n_episodes=n_episodes, seed=TEST_VOLUMES_SEED, on_plane=on_plane)
        own = RANDOM if isinstance(agent, RandomAgent) else None
        if result is None:
            return cls(evaluations, baselines, own_baseline=own)
        note_on = getattr(agent, "weights_note", None)
        note = None if note_on is None else note_on(result.best.n_env_steps)
        return cls(evaluations, baselines, result.best.evaluation, own, note)

    @cached_property
    def figures(self) -> dict[str, MetricEstimates]:
        """Figures with their intervals, by the names of the agent's volumes and of the baselines."""
        played = {**self.baselines, **self.evaluations}
        played |= {VALIDATION: self.validation} if self.validation else {}
        figures = {name: MetricEstimates.of(evaluation) for name, evaluation in played.items()}
        random = None if self.own_baseline == RANDOM else self.baselines.get(RANDOM)
        return figures | {TEST: beside_random(figures[TEST], [self.evaluations[TEST]], random)}

    def table(self) -> ResultTable:
        """Return the agent on the test volumes, the baselines there, then the agent on its other volumes."""
        return result_table({name: each for name, each in self.figures.items() if name != self.own_baseline})

    def metrics(self) -> dict[str, dict[str, float]]:
        """Return the numbers of the table, and all means, by the names of the volumes and of the baselines."""
        shown = [column.metric for column in self.table().quantities]
        metrics = {
            name: figures.shown_metrics([*shown, *figures.estimates.keys() & {ABOVE_RANDOM}])
            for name, figures in self.figures.items()
        }
        for name, evaluation in self.evaluations.items():
            metrics[name] |= evaluation.metrics()
        return metrics

    def markdown(self) -> str:
        """Return the table of agent and baselines on the test volumes, and the notes, in Markdown."""
        shown = {TEST, *self.baselines} - {self.own_baseline}
        table = result_table({name: each for name, each in self.figures.items() if name in shown})
        return "\n\n".join([table.markdown(), *self.notes()])

    def model_metrics(self) -> dict[str, list[str]]:
        """Return the names of the metrics that describe the run's checkpoint, by split."""
        names = [*(limits.metric for limits in self.evaluations[TEST].on_plane), *LEADING]
        groups = {"test": TEST_METRICS, "validation": "validation"}
        return {part: [f"{group}/{name}" for name in names] for part, group in groups.items()}

    def notes(self) -> list[str]:
        """Return the note on the weights, if there is one, and those on the volumes; see `volume_notes`."""
        on_weights = [self.weights_note] if self.weights_note else []
        return [*on_weights, *volume_notes(self.figures[TEST], self.figures.get(VALIDATION))]

    def write(self, folder: Path, *, title: str) -> None:
        """Write all episodes, and a page with the table, to the folder of the run."""
        for file, evaluations in ((EVALUATION_FILE, self.evaluations), (BASELINES_FILE, self.baselines)):
            contents = {name: evaluation.to_dict() for name, evaluation in evaluations.items()}
            atomic_write(folder / file, json.dumps(contents, indent=1))
        atomic_write(folder / RESULTS_PAGE, page(title, self.table().html(), notes=self.notes()))


def result_table(figures: Mapping[str, MetricEstimates]) -> ResultTable:
    """Return the table of figures, by the names of the agent's volumes and of the baselines, test volumes first."""
    of_agent = [name for name in TITLES if name in figures and name != TEST]
    baselines = [name for name in figures if name not in TITLES]
    ordered = [*([TEST] if TEST in figures else []), *baselines, *of_agent]
    tested, random = ({AGENT: figures[name]} if name in figures else {} for name in (TEST, RANDOM))
    titled = {TITLES.get(name, f"{name}, test"): figures[name] for name in ordered}
    return ResultTable(titled, headline=headline(tested, random))


def figures_of(metrics: Mapping[str, float]) -> dict[str, MetricEstimates]:
    """Return the figures that a run has tracked, by the names of the agent's volumes and of the baselines.

    Args:
        metrics: Metrics of the run, by name; those of single volumes are left out.
    """
    return {
        NAMES.get(group, group.replace("_", " ")): figures
        for group, figures in _by_group(metrics).items()
        if "/" not in group and group not in LEFT_OUT
    }


def evaluation_table(metrics: Mapping[str, float]) -> ResultTable:
    """Return the table of what `armscan evaluate` has tracked: the agent and the baselines on each group of volumes."""
    titled = {}
    for group, figures in _by_group(metrics).items():
        if not group.startswith(VOLUME_PREFIX):
            baseline, _, volumes = group.rpartition("/")
            titled[f"{baseline or AGENT}, {volumes.replace('_', ' ')}"] = figures
    return ResultTable(titled)


def _by_group(metrics: Mapping[str, float]) -> dict[str, MetricEstimates]:
    groups = [name.removesuffix(EVALUATED) for name in metrics if name.endswith(EVALUATED)]
    return {
        group: MetricEstimates.of_metrics(
            {name.removeprefix(f"{group}/"): each for name, each in metrics.items() if name.startswith(f"{group}/")}
        )
        for group in groups
    }


def volume_notes(test: MetricEstimates, validation: MetricEstimates | None = None) -> list[str]:
    """Return the notes on a result's volumes: intervals that do not overlap, or too few wrists.

    Args:
        test: Metrics on the test volumes.
        validation: Metrics on the validation volumes. Default: None, not validated.
    """
    notes = few_subjects({"test ": test} | ({"validation ": validation} if validation is not None else {}))
    if validation is not None:
        leading = test.on_plane[0]
        here, there = (each.estimate(leading.metric) for each in (test, validation))
        if here.low > there.high or there.low > here.high:
            known, new = (formatted(PERCENT, each.value) for each in (there, here))
            notes.append(
                f"{leading.title}: {known} on the validation and {new} on the test volumes, and the intervals do not "
                "overlap: volumes differ more than episodes do, and other wrists may lie anywhere between or outside"
            )
    return notes


def few_subjects(figures: Mapping[str, MetricEstimates]) -> list[str]:
    """Return a note if intervals come from too few subjects, as far as their number is known.

    Args:
        figures: Metrics by the word that describes the subjects, which ends with a blank, or is empty.
    """
    few = [
        counted(each.n_subjects, f"{of}subject") for of, each in figures.items() if 0 < each.n_subjects < MIN_SUBJECTS
    ]
    if not few:
        return []
    too_narrow = "the intervals are too narrow for other subjects; more subjects would help"
    return [f"{' and '.join(few)}, fewer than {MIN_SUBJECTS}: {too_narrow}"]

"""A trial that trains agents: one after another, with each of its seeds."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import optuna
from omegaconf import DictConfig

from armscan.agents import Learner
from armscan.building import build, check_keys
from armscan.errors import CheckpointError, InvalidValueError
from armscan.experiment import FILM_SEED, judged, learned
from armscan.files import CURVE_FILE, EVALUATION_FILE, FILM_FILE, LAST_CHECKPOINT, RUN_FILE, held, write_whole
from armscan.invocation import Invocation
from armscan.log import say
from armscan.multirun import Job
from armscan.patience import PATIENCE_S
from armscan.policies.making import keep_policy
from armscan.provenance import place_tags, start_tracking, volume_tags
from armscan.settings import plain
from armscan.stage import Stage
from armscan.sweeps.attempt import Attempt
from armscan.sweeps.tally import ENV_STEPS
from armscan.sweeps.tasks import VolumesInMemory
from armscan.tracking import TrackedRun, draw_learning_curve, open_store, take_over
from armscan.training import TEST, EpochReport, Evaluation, film_episode, take_up
from armscan.training.seeds import interquartile_mean

# Of each training, beside the figures of its best validation.
TRAINING_FIGURES = (ENV_STEPS, "training_s", "solved")
Conclude = Callable[[Stage, TrackedRun, Path], dict[str, float]]


@dataclass
class Reporter:
    """A training callback that reports to the study.

    Args:
        attempt: at the trial.
        seed: of the training.
        grid: environment steps between two reports.
        total: environment steps of a whole training.
    """

    attempt: Attempt
    seed: int
    grid: int
    total: int
    reports: list[EpochReport] = field(default_factory=list)

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Reports again what an attempt before has reported."""
        for report in earlier:
            self.on_epoch(report)

    def on_epoch(self, report: EpochReport) -> None:
        """Reports an epoch.

        Raises:
            optuna.TrialPruned: if the trial is not worth going on with.
        """
        self.reports.append(report)
        figures = report.evaluation.metrics()
        at = {"n_env_steps": report.n_env_steps, "grid": self.grid, "total": self.total}
        self.attempt.report(figures, seed=self.seed, **at)

    def on_end(self) -> None:
        """Has reported everything."""


class Training:
    """The task of training an agent, with each of a trial's seeds."""

    def __init__(self) -> None:
        self._volumes = VolumesInMemory()

    @property
    def figures(self) -> tuple[str, ...]:
        """Those of the best validation, and those of the training."""
        return (*Evaluation(()).metrics(), *TRAINING_FIGURES)

    @property
    def judged(self) -> str:
        """The mean steps of an episode."""
        return "test/mean_steps"

    def check(self, config: DictConfig) -> None:
        """See `Task.check`."""
        check_keys(config)
        experiment = build(config, self._volumes.of(config))
        if not isinstance(experiment.agent, Learner):
            raise InvalidValueError(
                f"agent is {config.agent.get('_target_')!r}, but the trials of this study need one that learns"
            )

    def run(self, attempt: Attempt) -> dict[str, float]:
        """Trains with each seed; returns the interquartile means of the figures over the seeds. See `Task.run`."""
        for seed in attempt.seeds:
            if seed not in attempt.seeds_done:
                attempt.keep_seed(seed, trained(attempt, seed))
        of_seeds = [attempt.seeds_done[seed] for seed in attempt.seeds]
        return {name: float(interquartile_mean([figures[name] for figures in of_seeds])) for name in of_seeds[0]}

    def judge(self, attempt: Attempt) -> dict[str, float]:
        """Trains, plays the final evaluations, films an episode, keeps the policy; returns the test's figures."""
        (seed,) = attempt.seeds
        return trained(attempt, seed, _concluded)


def _concluded(stage: Stage, tracked: TrackedRun, folder: Path) -> dict[str, float]:
    evaluations = judged(stage)
    contents = {name: evaluation.to_dict() for name, evaluation in evaluations.items()}
    (folder / EVALUATION_FILE).write_text(json.dumps(contents, indent=1))
    agent, seed = stage.experiment.agent, FILM_SEED + stage.experiment.seed
    film_episode(agent, stage.film_env, folder / FILM_FILE, seed=seed)
    assert isinstance(agent, Learner)
    keep_policy(agent, stage.test_env, tracked, folder, say)
    figures = {f"test/{name}": value for name, value in evaluations[TEST].metrics().items()}
    for volume, evaluation in evaluations[TEST].by_volume().items():
        figures |= {f"test/volume/{volume}/{name}": value for name, value in evaluation.metrics().items()}
    return figures


def trained(attempt: Attempt, seed: int, conclude: Conclude | None = None) -> dict[str, float]:
    """Trains with one seed, from the last checkpoint where there is one.

    Args:
        attempt: at the trial.
        seed: one of its seeds.
        conclude: what is done with the trained agent; returns further figures.

    Returns:
        The figures of the best validation, of the training, and those that `conclude` returns.

    Raises:
        optuna.TrialPruned: if the trial is not worth going on with.
    """
    config, choices = attempt.config(seed)
    stage = Stage.built(config)
    folder = attempt.folder / f"seed_{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    budget = stage.experiment.budget
    reporter = Reporter(attempt, seed, grid=budget.epoch_env_steps, total=budget.env_steps)
    pruned, concluded = None, {}
    with held(folder):
        stage, tracked, earlier = _begun(attempt, seed, stage, config, choices, folder)
        attempt.opened(tracked)
        with tracked:
            try:
                result = learned(stage, folder, [tracked, reporter], run_id=tracked.run_id, earlier=earlier)
            except optuna.TrialPruned as error:
                pruned = error
            else:
                concluded = conclude(stage, tracked, folder) if conclude else {}
            draw_learning_curve(reporter.reports, folder / CURVE_FILE, title=tracked.name)
            attempt.show_picture(folder / CURVE_FILE)
            # Nobody goes on with it; the best one stays.
            (folder / LAST_CHECKPOINT).unlink(missing_ok=True)
            tracked.log_results(folder)
            tracked.log_files(folder / RUN_FILE)
        attempt.opened(None)
    if pruned is not None:
        raise pruned
    best = result.best.evaluation.metrics()
    measured = (result.reports[-1].n_env_steps, result.wall_s, float(result.is_solved))
    return best | dict(zip(TRAINING_FIGURES, measured, strict=True)) | concluded


def _begun(
    attempt: Attempt, seed: int, stage: Stage, config: DictConfig, choices: dict[str, str], folder: Path
) -> tuple[Stage, TrackedRun, list[EpochReport]]:
    """Opens the tracked run of a training, and takes the agent to where an attempt before has left it."""
    _take_over(attempt, folder)
    begun, agent = folder / RUN_FILE, stage.experiment.agent
    assert isinstance(agent, Learner)
    if begun.exists() and (folder / LAST_CHECKPOINT).exists():
        run_id = json.loads(begun.read_text())["run_id"]
        try:
            earlier = take_up(agent, folder, stage.origin(run_id))
        except CheckpointError:
            # Whatever has happened to it, the trial can be begun again, with an agent that has learned nothing.
            stage = Stage.built(config)
        else:
            client, _ = open_store(**plain(config.tracking), patience_s=PATIENCE_S)
            tags = volume_tags(stage.fingerprints) | place_tags(folder)
            tags["mlflow.parentRunId"] = attempt.run_id
            return stage, TrackedRun.go_on(client, run_id, folder=folder, config=plain(config), tags=tags), earlier
    job = Job(attempt.trial.number, " ".join(attempt.overrides), "", attempt.run_id, attempt.study_folder)
    invocation = Invocation(folder, attempt.overrides, attempt.command, choices, job)
    tracked = start_tracking(config, invocation, stage, patience_s=PATIENCE_S)
    tracked.set_tags({"study": attempt.trial.study.study_name, "trial": str(attempt.trial.number)})
    write_whole(begun, lambda file: file.write(json.dumps({"run_id": tracked.run_id}).encode()))
    return stage, tracked, []


def _take_over(attempt: Attempt, folder: Path) -> None:
    """Copies what the attempt before has left, where this one has nothing of its own yet."""
    before = attempt.folder_before / folder.name if attempt.folder_before else None
    if before is None or (folder / RUN_FILE).exists() or not (before / RUN_FILE).exists():
        return
    for file in before.iterdir():
        if file.is_file() and not file.name.startswith(".") and file.name != RUN_FILE:
            shutil.copyfile(file, folder / file.name)
    take_over(json.loads((before / RUN_FILE).read_text())["run_id"], before, folder)
    # Last: from then on this folder counts.
    shutil.copyfile(before / RUN_FILE, folder / RUN_FILE)

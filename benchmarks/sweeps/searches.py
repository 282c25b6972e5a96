"""Search with armscan and with Hydra's Optuna sweeper on a budget of processor time; both train in this process.

A trial costs the processor time of this process, all threads together, while the trial's task runs: building,
training, validating, tracking and reporting. Neither side pays for starting processes, nor for its sampler.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import yaml
from omegaconf import OmegaConf
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.trial import TrialState

from armscan.config.defaults import to_plain
from armscan.sweeps.scheduling.claim import ClaimStatus
from armscan.sweeps.scheduling.race import Scores, race
from armscan.sweeps.scheduling.scheduler import Plan, TrialScheduler
from armscan.sweeps.scheduling.state import StudyState
from armscan.sweeps.space.parameter import Value
from armscan.sweeps.study.arguments import fixed_by
from armscan.sweeps.study.candidates import settings_of
from armscan.sweeps.study.components import read_settings
from armscan.sweeps.study.open import open_for_work
from armscan.sweeps.study.phase import OpenedStudy, Phase
from armscan.sweeps.study.settings import FinalEvalSettings
from armscan.sweeps.study.study import best_trials
from armscan.sweeps.study.warm_start import initial_trials
from armscan.sweeps.tasks.attempt import Attempt
from armscan.sweeps.workers.heartbeat import Heartbeat
from armscan.sweeps.workers.worker import Worker
from benchmarks.sweeps.compare_sweepers import HYDRA_OPTUNA, hydra_python

NAME, WITHOUT_END = "search", 10**6


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """Best configuration of a search, and its cost.

    Args:
        values: Values of the best configuration by their keys; empty for the default configuration.
        processor_s: Processor seconds of all trials, the trainings of the race included.
        n_trials: Number of trials.
        n_pruned: Number of pruned trials. Default: 0.
        n_raced: Number of trainings of the race over seeds. Default: 0, no race.
    """

    values: Mapping[str, Value]
    processor_s: float
    n_trials: int
    n_pruned: int = 0
    n_raced: int = 0


class Meter:
    """Measures the processor time of trials.

    Args:
        budget_s: Processor seconds after which no trial begins.
    """

    def __init__(self, budget_s: float) -> None:
        self.budget_s, self.used_s = budget_s, 0.0

    def is_used(self, kept_s: float = 0.0) -> bool:
        """Return whether at most `kept_s` processor seconds are left."""
        return self.used_s + kept_s >= self.budget_s

    def timed(self, run: Callable[[Attempt], dict[str, float]]) -> Callable[[Attempt], dict[str, float]]:
        """Return a task whose processor time is added to the used time."""

        def timed(attempt: Attempt) -> dict[str, float]:
            start_s = time.process_time()
            try:
                return run(attempt)
            finally:
                self.used_s += time.process_time() - start_s

        return timed


class BudgetedScheduler(TrialScheduler):
    """A scheduler that claims no trial once the budget is used."""

    def __init__(self, phase: Phase, is_used: Callable[[], bool], plan: Plan | None) -> None:
        before = phase.scheduler
        super().__init__(before.study, before.storage, before.limits, plan)
        self._is_used = is_used

    def claim_status(self, state: StudyState) -> ClaimStatus:
        """See `TrialScheduler.claim_status`."""
        return ClaimStatus("the budget is used") if self._is_used() else super().claim_status(state)


def search_by_armscan(words: Sequence[str], budget_s: float, _: Path) -> SearchResult:
    """Search with a study of armscan: half of the budget for the search, the rest for the race."""
    opened = open_for_work(*read_settings(words), words)
    assert opened.final_eval is not None
    meter, final = Meter(budget_s), opened.final_eval
    _add_presets(words, opened, opened.search.scheduler.study)

    _work(opened.search, words, meter, lambda: meter.is_used(kept_s=budget_s / 2))
    _work(opened.finals[0], words, meter, meter.is_used, final.missing_of_selection)
    searched = final.search.get_trials()
    chosen = chosen_of(final.scores(), final.selection_seeds, final.settings)
    number = best_trials(final.search, 1)[0].number if chosen is None else chosen
    n_pruned = sum(trial.state == TrialState.PRUNED for trial in searched)
    n_raced = len(final.selection.get_trials(states=(TrialState.COMPLETE,)))
    return SearchResult(settings_of(searched, number), meter.used_s, len(searched), n_pruned, n_raced)


def chosen_of(scores: Scores, seeds: Sequence[int], settings: FinalEvalSettings) -> int | None:
    """Return the choice of the longest race with complete rounds; None unless each candidate has its first seed.

    Args:
        scores: See `race`.
        seeds: All seeds of the race.
        settings: Their `mean_seeds` is that of the longest race, their `min_seeds` that of the first round, which is
            shortened if it is not complete.
    """
    means = range(settings.mean_seeds, 0, -1)
    shorter = (race(scores, seeds, min_seeds=min(n, settings.min_seeds), mean_seeds=n) for n in means)
    return next((each.chosen for each in shorter if each.chosen is not None), None)


def search_by_hydra(words: Sequence[str], budget_s: float, folder: Path) -> SearchResult:
    """Search with Hydra's Optuna sweeper; its trials are trained as in a study without a pruner."""
    words = [*words, "study/pruner=none", "study.final_eval.top_k=0"]
    opened, meter = open_for_work(*read_settings(words), words), Meter(budget_s)
    study, storage = opened.search.scheduler.study, f"sqlite:///{folder.absolute()}/hydra.db"
    _add_presets(words, opened, optuna.create_study(study_name=NAME, storage=storage))
    (folder / "trained.yaml").write_text(yaml.safe_dump(_hydra_config(opened, folder, storage)))
    command = [hydra_python(), HYDRA_OPTUNA / "trained.py", "-m", "--config-dir", folder, "--config-name", "trained"]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with (folder / "hydra.log").open("w") as log, subprocess.Popen(command, stderr=log, **pipes) as process:
        for line in process.stdout or ():
            if meter.is_used():
                process.terminate()
                break
            study.enqueue_trial(fixed_by(json.loads(line)))
            # An empty plan: only enqueued trials run.
            _work(opened.search, words, meter, lambda: False, list)
            print(study.get_trials()[-1].values[0], file=process.stdin, flush=True)
    assert meter.is_used(), f"the sweeper ended early: see {folder / 'hydra.log'}"
    return SearchResult(best_trials(study, 1)[0].params, meter.used_s, len(study.get_trials()))


def _work(
    phase: Phase, words: Sequence[str], meter: Meter, is_used: Callable[[], bool], plan: Plan | None = None
) -> None:
    scheduler = BudgetedScheduler(phase, is_used, plan)
    heartbeat = Heartbeat(scheduler, NAME, should_leave=lambda: False, leave=lambda: None, on_death=phase.close_runs_of)
    budgeted = dataclasses.replace(phase, scheduler=scheduler, run=meter.timed(phase.run))
    with heartbeat.running():
        Worker(budgeted, words, heartbeat).work()


def _add_presets(words: Sequence[str], opened: OpenedStudy, study: optuna.Study) -> None:
    for each in initial_trials(opened.settings, words, to_plain(opened.config), None):
        for values in each.enqueued:
            study.enqueue_trial(values)


def _hydra_config(opened: OpenedStudy, folder: Path, storage: str) -> dict[str, Any]:
    parameters = {each.name: each.distribution for each in opened.settings.space.parameters}
    values = OmegaConf.create()
    for name in parameters:
        OmegaConf.update(values, name, None)
    sweeper = {
        "study_name": NAME,
        "storage": storage,
        "n_trials": WITHOUT_END,
        "n_jobs": 1,
        "direction": next(iter(opened.settings.objectives.values())),
        "sampler": {"seed": opened.settings.seed},
        "params": {name: swept(distribution) for name, distribution in parameters.items()},
    }
    sweep = {"dir": str(folder / "hydra"), "subdir": "."}
    return {
        "defaults": ["_self_", {"override hydra/sweeper": "optuna"}],
        "hydra": {"output_subdir": None, "sweep": sweep, "sweeper": sweeper},
        **to_plain(values),
    }


def swept(distribution: BaseDistribution) -> str:
    """Return a distribution in the syntax of Hydra's sweeper; integers are not supported."""
    if isinstance(distribution, CategoricalDistribution):
        return f"choice({','.join(map(str, distribution.choices))})"
    assert isinstance(distribution, FloatDistribution)
    interval = f"interval({distribution.low},{distribution.high})"
    return f"tag(log,{interval})" if distribution.log else interval

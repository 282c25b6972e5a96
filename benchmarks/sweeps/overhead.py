"""Measure the time that a study adds to a trial beside its training.

A trial counts from its claim to its tell, by the storage. That includes closing the tracked run of the worker's trial
before, because a worker tells one trial and claims the next at once. All of this time is the study's, except what a
single run of `armscan.run` does as well. That is the task: it builds environments and agent, tracks the training,
writes checkpoints and draws the learning curve. Within the task, the calls to the attempt (`OF_STUDY`) are the study's:
setting the seed in the configuration, the reports with the pruner's answer, the metrics of each finished seed, and the
picture for the dashboard.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, Self

from omegaconf import DictConfig
from optuna.trial import FrozenTrial

from armscan.sweeps.storage.attribute_names import METRICS
from armscan.sweeps.tasks.attempt import Attempt
from armscan.sweeps.tasks.training import TrainingTask
from benchmarks.sweeps.studies import by_worker, finish
from benchmarks.tables import print_head, print_row

OF_STUDY = ("config", "opened", "report", "keep_seed", "show_picture")
N_WORKERS = 2
# A minute of training for each trial, with any learning rate.
TRAINING = (
    *(
        "study.task._target_=benchmarks.sweeps.overhead.TimedTraining",
        f"study.workers={N_WORKERS}",
        "training.env_steps=20000",
        # A pruned trial keeps no metrics.
        "study/pruner=none",
    ),
    *("agent.utd_ratio=0.4", "agent.batch_size=128", "+study.sampler.n_startup_trials=1"),
)


class TimedTraining(TrainingTask):
    """The training task, which measures how much of its time is the study's."""

    def metrics(self, config: DictConfig) -> tuple[str, ...]:
        """Return the metrics of a training, the seconds of the whole task, and those of each call of `OF_STUDY`."""
        return (*super().metrics(config), "task_s", *(f"{name}_s" for name in OF_STUDY))

    def run(self, attempt: Attempt) -> dict[str, float]:
        """See `Task.run`."""
        spent_s = dict.fromkeys(OF_STUDY, 0.0)
        for name in OF_STUDY:
            setattr(attempt, name, _timed(getattr(attempt, name), name, spent_s))
        start_s = time.perf_counter()
        figures = super().run(attempt)
        task_s = time.perf_counter() - start_s
        return figures | {"task_s": task_s} | {f"{name}_s": seconds for name, seconds in spent_s.items()}


def _timed(method: Callable[..., Any], name: str, spent_s: dict[str, float]) -> Callable[..., Any]:
    @wraps(method)
    def timed(*arguments: Any, **named: Any) -> Any:
        start_s = time.perf_counter()
        try:
            return method(*arguments, **named)
        finally:
            spent_s[name] += time.perf_counter() - start_s

    return timed


@dataclass(frozen=True)
class Shares:
    """Seconds of a trial from its claim to its tell, in four parts that add up to the whole.

    Args:
        training_s: Seconds of learning, validating, tracking and writing checkpoints.
        single_s: Seconds of everything else that a single run does.
        around_s: Seconds of the study before and after the task.
        within_s: Seconds of the study within the task.
    """

    training_s: float
    single_s: float
    around_s: float
    within_s: float

    @classmethod
    def of(cls, trial: FrozenTrial) -> Self:
        """Return the shares of a finished trial."""
        figures = trial.user_attrs[METRICS]
        within_s = sum(figures[f"{name}_s"] for name in OF_STUDY)
        # The reports are made while the agent is trained.
        training_s = figures["training_s"] - figures["report_s"]
        trial_s = (trial.datetime_complete - trial.datetime_start).total_seconds()
        task_s = figures["task_s"]
        return cls(training_s, task_s - training_s - within_s, trial_s - task_s, within_s)

    @property
    def trial_s(self) -> float:
        """Seconds from claim to tell."""
        return self.training_s + self.single_s + self.around_s + self.within_s


def beside(folder: Path, *, trials: int = 10) -> None:
    """Train, and print the time that the study adds to each trial."""
    workers = by_worker(finish(folder, *TRAINING, f"study.n_trials={trials}")).values()
    shares = [Shares.of(trial) for of_worker in workers for trial in of_worker]
    # The tell of a trial and the claim of the next are one transaction, whose time counts for neither.
    study_s = [each.around_s + each.within_s for each in shares]
    rows = {
        "a trial, from claim to tell": [each.trial_s for each in shares],
        "its training: learning, validating, tracking, checkpoints": [each.training_s for each in shares],
        "the rest of a single run: building, its tracked run, the curve": [each.single_s for each in shares],
        "the study, before and after the task": [each.around_s for each in shares],
        "the study, within the task": [each.within_s for each in shares],
        "the study, in all": study_s,
        "the same, in % of the trial": [
            100 * own_s / each.trial_s for own_s, each in zip(study_s, shares, strict=True)
        ],
    }
    print(f"{len(shares)} trials by {len(workers)} workers\n")
    print_head("s", "median", "most")
    for name, seconds in rows.items():
        print_row(name, f"{statistics.median(seconds):.2f}", f"{max(seconds):.2f}")

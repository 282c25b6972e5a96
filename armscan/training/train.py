"""One training: epochs of learning, each followed by a validation, until the budget is used up or the task solved."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armscan.agents.protocols import Learner
from armscan.agents.schedule import Segment, read_schedule
from armscan.errors import InvalidValueError
from armscan.training.callbacks import Callback, EpochReport, best_of
from armscan.training.checkpoint_file import load_checkpoint
from armscan.training.checkpoints import CheckpointProvenance, save_checkpoints
from armscan.training.episode_results import BEST_BY, SUCCESS, Evaluation
from armscan.utils.run_files import BEST_CHECKPOINT
from armscan.utils.validation import check_choice, check_float, check_int


@dataclass(frozen=True, kw_only=True)
class SolvedCriterion:
    """Criterion that stops the training before its budget is used up.

    Args:
        success_rate: Lowest success rate on the validation episodes, in [0, 1]. Default: 1.
        mean_steps: Largest mean number of steps on the validation episodes, 1 or more. Default: 1.2.
        n_epochs: Number of consecutive epochs that must meet both criteria, 1 or more. Default: 3.
    """

    success_rate: float = 1.0
    mean_steps: float = 1.2
    n_epochs: int = 3

    def __post_init__(self) -> None:
        check_float("training.solved.success_rate", self.success_rate, at_least=0.0, at_most=1.0)
        check_float("training.solved.mean_steps", self.mean_steps, at_least=1.0)
        check_int("training.solved.n_epochs", self.n_epochs, at_least=1)

    def holds(self, reports: Sequence[EpochReport]) -> bool:
        """Return whether the last epochs meet the criterion."""
        last = reports[-self.n_epochs :]
        return len(last) == self.n_epochs and all(
            report.evaluation.success_rate >= self.success_rate and report.evaluation.mean_steps <= self.mean_steps
            for report in last
        )


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Budget of a training: its length, and its validations.

    Args:
        env_steps: Largest number of environment steps, 1 or more; rounded up to the number that the agent takes at
            once.
        eval_every_env_steps: Environment steps between two validations, 1 or more; rounded up in the same way. A
            validation cuts off unfinished episodes, so at least the environments times the steps of an episode.
        validation_episodes: Number of episodes of each validation, 1 or more.
        solved: Criterion that stops the training early. Default: None, the whole budget is used.
        best_by: Criterion that chooses the best epoch: `success`, the highest rate, then the fewest steps; or
            `distance`, the least sum of mean distance in mm and mean angle in degrees. Default: `success`.
        schedule: Changes of the agent's hyperparameters, a mapping for each: `from_env_steps` and values by keys, such
            as `agent.lr`. Each applies from the first epoch that begins at or after `from_env_steps`; a value lasts
            until another change of it. Default: None, no changes.
    """

    env_steps: int
    eval_every_env_steps: int
    validation_episodes: int
    solved: SolvedCriterion | None = None
    best_by: str = SUCCESS
    schedule: Sequence[Mapping[str, Any]] | None = None

    def __post_init__(self) -> None:
        for name in ("env_steps", "eval_every_env_steps", "validation_episodes"):
            check_int(f"training.{name}", getattr(self, name), at_least=1)
        check_choice("training.best_by", self.best_by, BEST_BY)
        if self.solved is not None and not isinstance(self.solved, SolvedCriterion):
            raise InvalidValueError(f"training.solved is {self.solved!r}, but it must be a SolvedCriterion or null")
        read_schedule(self.schedule, self.env_steps)

    @property
    def segments(self) -> tuple[Segment, ...]:
        """The changes of `schedule`, in order."""
        return read_schedule(self.schedule, self.env_steps)


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training; the learner holds its best weights again.

    Args:
        reports: Report of each epoch, in order.
        is_solved: Whether it stopped early because the task was solved.
        wall_s: Seconds of the training, checkpoints and callbacks included, before and after an interruption.
    """

    reports: tuple[EpochReport, ...]
    is_solved: bool
    wall_s: float

    @property
    def best(self) -> EpochReport:
        """The epoch whose weights the learner holds."""
        return best_of(self.reports)


def train(
    learner: Learner,
    budget: Budget,
    validate: Callable[[], Evaluation],
    folder: Path,
    callbacks: Sequence[Callback] = (),
    *,
    provenance: CheckpointProvenance | None = None,
    earlier: Sequence[EpochReport] = (),
    until_env_steps: int | None = None,
) -> TrainingResult:
    """Train a learner; it ends with the weights of its best epoch.

    Args:
        learner: Learner to train.
        budget: Length of the training and of its epochs, in environment steps.
        validate: Function that evaluates the learner on the validation volumes.
        folder: Folder that keeps `best.pt` and `last.pt`.
        callbacks: Callbacks at the start, after each epoch and at the end. Default: none.
        provenance: Origin of the checkpoints, kept in them. Default: None.
        earlier: Reports that `resume_from_checkpoint` returned, for a resumed training. Default: none.
        until_env_steps: Environment steps after which this part of the training ends, at the end of an epoch. Default:
            None, at the end of the budget.

    Returns:
        The reports of all epochs, whether the task was solved, and the training time.
    """
    reports = list(earlier)
    start_s = time.perf_counter() - (reports[-1].wall_s if reports else 0.0)
    is_solved = budget.solved is not None and budget.solved.holds(reports)
    n_at_once = learner.env_steps_at_once
    rounded_up = math.ceil(budget.env_steps / n_at_once) * n_at_once
    with ExitStack() as stack:
        for callback in callbacks:
            # Also called if a later callback fails to start.
            stack.callback(callback.on_end)
            callback.on_start(rounded_up, tuple(reports))
        if not reports:
            learner.warm_up()
        end = min(budget.env_steps, until_env_steps or budget.env_steps)
        while learner.n_env_steps < end and not is_solved:
            metrics = learner.learn(min(budget.eval_every_env_steps, budget.env_steps - learner.n_env_steps))
            evaluation = validate()
            by = budget.best_by
            score = evaluation.score(by)
            report = EpochReport(
                epoch=len(reports) + 1,
                n_env_steps=learner.n_env_steps,
                wall_s=time.perf_counter() - start_s,
                metrics=metrics,
                evaluation=evaluation,
                is_best=all(score > before.evaluation.score(by) for before in reports),
            )
            reports.append(report)
            save_checkpoints(learner, reports, folder, provenance)
            for callback in callbacks:
                callback.on_epoch(report)
            is_solved = budget.solved is not None and budget.solved.holds(reports)
    learner.load_weights(load_checkpoint(folder / BEST_CHECKPOINT)[0])
    return TrainingResult(tuple(reports), is_solved, time.perf_counter() - start_s)

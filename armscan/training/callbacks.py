"""What training reports while it goes on, and to whom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from armscan.training.evaluation import Evaluation


@dataclass(frozen=True, kw_only=True)
class EpochReport:
    """What is known at the end of an epoch.

    Args:
        epoch: its number, from 1.
        n_env_steps: environment steps taken so far.
        wall_s: seconds of training so far; the time between an interruption and a resumption is none.
        metrics: means of the epoch's training, by name.
        evaluation: on the validation volumes.
        is_best: whether no epoch before was as good.
    """

    epoch: int
    n_env_steps: int
    wall_s: float
    metrics: dict[str, float]
    evaluation: Evaluation
    is_best: bool


class Callback(Protocol):
    """Whoever wants to know how training goes."""

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Called once, before the first step.

        Args:
            total_env_steps: that training may take.
            earlier: the epochs before, where a training goes on; whoever was told of them may have been killed since.
        """

    def on_epoch(self, report: EpochReport) -> None:
        """Called at the end of every epoch."""

    def on_end(self) -> None:
        """Called once, when training ends, also when it ends by an error."""

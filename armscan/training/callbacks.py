"""Callbacks of a training, and the reports that they receive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from armscan.training.episode_results import Evaluation


@dataclass(frozen=True, kw_only=True)
class EpochReport:
    """Report at the end of an epoch.

    Args:
        epoch: number of the epoch, from 1.
        n_env_steps: environment steps taken so far.
        wall_s: seconds of training so far; the time between an interruption and a resumption is none.
        metrics: means of the epoch's training, by name.
        evaluation: evaluation on the validation volumes.
        is_best: whether no epoch before was as good.
    """

    epoch: int
    n_env_steps: int
    wall_s: float
    metrics: dict[str, float]
    evaluation: Evaluation
    is_best: bool


class Callback(Protocol):
    """Receives the events of a training."""

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Handle the start, called once before the first step.

        Args:
            total_env_steps: environment steps that training may take.
            earlier: epochs before the interruption of a resumed training; they may be reported a second time.
        """

    def on_epoch(self, report: EpochReport) -> None:
        """Handle the end of an epoch."""

    def on_end(self) -> None:
        """Handle the end of training, called once, also after an error."""

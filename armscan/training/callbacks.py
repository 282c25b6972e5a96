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
        epoch: Number of the epoch, from 1.
        n_env_steps: Environment steps taken so far.
        wall_s: Seconds of training so far, without the time between an interruption and its resumption.
        metrics: Means of the epoch's training metrics, by name.
        evaluation: Evaluation on the validation volumes.
        is_best: Whether the epoch is better than all before it.
    """

    epoch: int
    n_env_steps: int
    wall_s: float
    metrics: dict[str, float]
    evaluation: Evaluation
    is_best: bool


def best_of(reports: Sequence[EpochReport]) -> EpochReport:
    """Return the best epoch, whose weights are kept."""
    return [report for report in reports if report.is_best][-1]


class Callback(Protocol):
    """Receives the events of a training."""

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Handle the start, called once before the first step.

        Args:
            total_env_steps: Environment steps that training may take, whole collections.
            earlier: Epochs before the interruption of a resumed training; some may have been reported already.
        """

    def on_epoch(self, report: EpochReport) -> None:
        """Handle the end of an epoch."""

    def on_end(self) -> None:
        """Handle the end of training, called once, also after an error."""

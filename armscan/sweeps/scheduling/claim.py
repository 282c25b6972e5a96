"""A claim: the outcome and the pending writes of the last trial, and the trials planned next."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from optuna.trial import Trial, TrialState

T = TypeVar("T")


class PendingWrites(list[Callable[[], object]]):
    """Short writes about a trial, sent with its next report, its outcome or its requeue.

    A write is repeated if the storage became unavailable before it confirmed it. The worker's thread appends and
    flushes; another thread may call `write` when it requeues the trial.
    """

    def write(self) -> int:
        """Write all; return how many."""
        writes = self.copy()
        for write in writes:
            write()
        return len(writes)

    def flush_with(self, transaction: Callable[[Callable[[], Any]], Any], operate: Callable[[], T]) -> T:
        """Write all in one transaction with an operation, forget them, and return what the operation returns.

        Args:
            transaction: Function that runs a transaction; see `Storage.transaction`.
            operate: Operation to run, which may be called several times.
        """
        n_written: int
        done: T
        n_written, done = transaction(lambda: (self.write(), operate()))
        del self[:n_written]
        return done


@dataclass(frozen=True)
class PlannedTrial:
    """A trial to enqueue.

    Args:
        params: Its values by parameter name.
        attributes: Its user attributes.
    """

    params: Mapping[str, Any]
    attributes: Mapping[str, Any]


@dataclass(frozen=True)
class ClaimStatus:
    """Whether a trial can be claimed.

    Args:
        end_reason: Why no further trial is claimed; None while trials are missing.
        can_claim: Whether one can be claimed now. Default: False.
        planned: Trials to enqueue before claiming. Default: none.
    """

    end_reason: str | None
    can_claim: bool = False
    planned: Sequence[PlannedTrial] = ()


@dataclass
class TrialOutcome:
    """Outcome of a trial, told to Optuna with the next claim.

    Args:
        trial: Trial that has ended.
        state: State of the trial: COMPLETE, PRUNED or FAIL.
        writes: Pending writes of the trial's attributes.
        values: Values of the objectives, for a complete trial only.
        attributes: User attributes of the trial.
    """

    trial: Trial
    state: TrialState
    writes: PendingWrites
    values: Sequence[float] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    # Stays False if another worker has taken this one for dead, and taken over the trial.
    is_told: bool = field(default=False, init=False)

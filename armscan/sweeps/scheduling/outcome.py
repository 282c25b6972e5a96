"""Outcome of a trial and pending writes, which share one round trip to the storage with the next request."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from optuna.trial import Trial, TrialState

T = TypeVar("T")


class PendingWrites(list[Callable[[], object]]):
    """Short writes about a trial, which go with its next report, its outcome or its requeue.

    Each is repeated if the storage went away before the write was known to be there. One thread appends and flushes; a
    requeue writes in another.
    """

    def write(self) -> int:
        """Write all; returns how many."""
        writes = self.copy()
        for write in writes:
            write()
        return len(writes)

    def flush_with(self, transaction: Callable[[Callable[[], Any]], Any], operate: Callable[[], T]) -> T:
        """Write all in one transaction with an operation, forget them, and return what the operation returns.

        Args:
            transaction: see `Storage.transaction`.
            operate: the operation, which may be called several times.
        """
        n_written: int
        done: T
        n_written, done = transaction(lambda: (self.write(), operate()))
        del self[:n_written]
        return done


@dataclass
class TrialOutcome:
    """Outcome of a trial, told to Optuna with the next claim.

    Args:
        trial: the trial that has ended.
        state: COMPLETE, PRUNED or FAIL.
        writes: those about the trial that are still pending.
        values: of the objectives, if it is complete.
        attributes: user attributes of the trial.
    """

    trial: Trial
    state: TrialState
    writes: PendingWrites
    values: Sequence[float] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    # Not if another worker has taken this one for dead, and the trial is theirs.
    is_told: bool = field(default=False, init=False)

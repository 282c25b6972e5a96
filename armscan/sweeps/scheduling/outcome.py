"""Outcome of a trial and pending writes, which share one round trip to the storage with whatever is asked next."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from optuna.trial import Trial, TrialState

T = TypeVar("T")


class PendingWrites:
    """Writes about a trial, which go with its next report, its outcome or its requeue.

    Each is repeated if the storage went away before the write was known to be there.
    """

    def __init__(self) -> None:
        self._writes: list[Callable[[], object]] = []
        # A requeue writes them in another thread.
        self._changing = threading.Lock()

    def add(self, write: Callable[[], object]) -> None:
        """Add a short write that may be repeated."""
        with self._changing:
            self._writes.append(write)

    def write(self) -> int:
        """Write all; returns how many."""
        with self._changing:
            writes = list(self._writes)
        for write in writes:
            write()
        return len(writes)

    def flush_with(self, transaction: Callable[[Callable[[], T]], T], operate: Callable[[], T]) -> T:
        """Write all in one transaction with an operation, and forget them.

        Args:
            transaction: see `Storage.transaction`.
            operate: may be called several times.

        Returns:
            What the operation returns.
        """
        n_written = 0

        def written() -> T:
            nonlocal n_written
            n_written = self.write()
            return operate()

        done = transaction(written)
        with self._changing:
            del self._writes[:n_written]
        return done


@dataclass
class TrialOutcome:
    """Outcome of a trial, told to Optuna with the next claim.

    Args:
        trial: that has ended.
        state: COMPLETE, PRUNED or FAIL.
        writes: about the trial, still pending.
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

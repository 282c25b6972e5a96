"""What is written of a trial at once, because each question to a storage costs a way there and back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from optuna.trial import Trial, TrialState

T = TypeVar("T")
Write = Callable[[], object]


class Notes:
    """What is to be written of a trial with whatever is written next: a report, its outcome, or that it is handed back.

    Each is written again where the storage went away before it was known to be there.
    """

    def __init__(self) -> None:
        self._writes: list[Write] = []
        # Also who hands the trial back writes them, in another thread.
        self._changing = threading.Lock()

    def add(self, write: Write) -> None:
        """Adds what may be written several times, and is short."""
        with self._changing:
            self._writes.append(write)

    def write(self) -> int:
        """Writes all; returns how many there were."""
        with self._changing:
            writes = list(self._writes)
        for write in writes:
            write()
        return len(writes)

    def written_with(self, together: Callable[[Callable[[], T]], T], operate: Callable[[], T]) -> T:
        """Writes all with an operation, and then no more.

        Args:
            together: does at once what is asked of the storage; see `Storage.together`.
            operate: may be called several times.

        Returns:
            What the operation returns.
        """
        n_written = 0

        def written() -> T:
            nonlocal n_written
            n_written = self.write()
            return operate()

        done = together(written)
        with self._changing:
            del self._writes[:n_written]
        return done


@dataclass
class Outcome:
    """What came of a trial, to be told with the next claim.

    Args:
        trial: that has ended.
        state: COMPLETE, PRUNED or FAIL.
        values: of the objectives, where it is complete.
        attributes: user attributes of the trial.
        notes: of the trial, not written yet.
    """

    trial: Trial
    state: TrialState
    notes: Notes
    values: Sequence[float] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    # Whether it was told: not where somebody has taken the worker for dead, and the trial is theirs.
    is_told: bool = field(default=False, init=False)


class Once:
    """Does something the first time it is called; others wait until it is done.

    Args:
        do: what is done.
    """

    def __init__(self, do: Write) -> None:
        self._do, self._doing, self._is_done = do, threading.Lock(), False

    def __call__(self) -> None:
        """Does it, if nobody has."""
        with self._doing:
            if not self._is_done:
                self._is_done = True
                self._do()

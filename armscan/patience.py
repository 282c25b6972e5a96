"""Waiting for a service that is away for a while: how long is waited, and what is said of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from armscan.errors import AwayError
from armscan.log import say

T = TypeVar("T")
PATIENCE_S = 600.0
# Between two attempts, at first and at most; each is twice as long as the one before.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 5.0

_this_thread = threading.local()


class Patience:
    """Repeats what is asked of a service while it is away.

    Args:
        what: the service is, such as `the storage`.
        named: which value names it, such as `study.storage is 'a.db'`; as it may be shown.
        reason: says of an error why the service cannot be reached for now; None where what it was asked is wrong.
        error: what is raised when it is not waited for any longer.
        patience_s: how long that is; `PATIENCE_S` where it is None.
    """

    def __init__(
        self,
        what: str,
        named: str,
        reason: Callable[[BaseException], str | None],
        error: type[AwayError],
        *,
        patience_s: float | None = None,
    ) -> None:
        self._what, self._named, self._reason, self._error = what, named, reason, error
        self._patience_s = PATIENCE_S if patience_s is None else patience_s
        self._changing = threading.Lock()
        self._n_waiting = 0
        self._is_over = False

    def through(self, operate: Callable[[], T]) -> T:
        """Returns what an operation returns, once the service is there.

        Args:
            operate: may be called several times, also when it was done, and only its answer was lost.

        Raises:
            AwayError: if the service stays away for as long as it is waited for, or this thread is `impatient`.
        """
        try:
            return operate()
        except Exception as error:
            reason, away = self._reason(error), error
            if reason is None:
                raise
        if getattr(_this_thread, "is_impatient", False):
            raise self._error(f"{self._named}, but it is away: {reason}") from away
        with self._told(reason):
            return self._waited(operate, reason, away)

    def _waited(self, operate: Callable[[], T], reason: str, away: Exception) -> T:
        until_s, pause_s = time.monotonic() + self._patience_s, FIRST_PAUSE_S
        while not self._is_over and time.monotonic() < until_s:
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            try:
                return operate()
            except Exception as error:
                told = self._reason(error)
                if told is None:
                    raise
                reason, away = told, error
        # Nobody waits any more after one has: what is cleared up on the way out would take as long again.
        self._is_over = True
        long = f"{self._patience_s:g} s" if self._patience_s < 60 else f"{self._patience_s / 60:g} minutes"
        raise self._error(f"{self._named}, but it has been away for {long}: {reason}") from away

    @contextmanager
    def _told(self, reason: str) -> Iterator[None]:
        """Says once that it is waited, and once that it is over, however many threads wait."""
        with self._changing:
            self._n_waiting += 1
            if self._n_waiting == 1 and not self._is_over:
                say(f"{self._what} is away ({reason}): waiting")
        is_back = True
        try:
            yield
        except (AwayError, KeyboardInterrupt):
            is_back = False
            raise
        finally:
            with self._changing:
                self._n_waiting -= 1
                if self._n_waiting == 0 and is_back:
                    say(f"{self._what} is back")


@contextmanager
def impatient() -> Iterator[None]:
    """What a thread is in that waits for no service, but is told by an `AwayError`."""
    before = getattr(_this_thread, "is_impatient", False)
    _this_thread.is_impatient = True
    try:
        yield
    finally:
        _this_thread.is_impatient = before

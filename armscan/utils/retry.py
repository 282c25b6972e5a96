"""Retry operations on a service that is temporarily unavailable."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from armscan.errors import ServiceUnavailableError
from armscan.utils.log import log

T = TypeVar("T")
RETRY_S = 600.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 5.0

_this_thread = threading.local()


def pauses_s() -> Iterator[float]:
    """Yield the pauses between attempts in seconds: each is twice as long as the one before, up to the longest."""
    pause_s = FIRST_PAUSE_S
    while True:
        yield pause_s
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)


class RetryPolicy:
    """Repeats operations while a service is unavailable.

    Args:
        what: Name of the service, such as `the storage`.
        named: Setting that names the service, for messages, such as `study.storage is 'a.db'`.
        reason: Function that returns why an error means that the service is unavailable, or None if it means something
            else.
        error: Error to raise after `retry_s`.
        retry_s: Seconds to retry. Default: `RETRY_S`.
    """

    def __init__(
        self,
        what: str,
        named: str,
        reason: Callable[[BaseException], str | None],
        error: type[ServiceUnavailableError],
        *,
        retry_s: float | None = None,
    ) -> None:
        self._what, self._named, self._reason, self._error = what, named, reason, error
        self._retry_s = RETRY_S if retry_s is None else retry_s
        self._changing = threading.Lock()
        self._n_waiting = 0
        self._is_over = False

    def call(self, operate: Callable[[], T]) -> T:
        """Return the result of an operation, once the service is available.

        Args:
            operate: Operation to call; it may be repeated although it succeeded, if only its answer was lost.

        Raises:
            ServiceUnavailableError: If the service stays unavailable, or this thread is in `no_retry`.
        """
        try:
            return operate()
        except Exception as error:
            reason, cause = self._reason(error), error
            if reason is None:
                raise
        if getattr(_this_thread, "no_retry", False):
            raise self._error(f"{self._named}, but it is unavailable: {reason}") from cause
        with self._log_outage(reason):
            return self._waited(operate, reason, cause)

    def _waited(self, operate: Callable[[], T], reason: str, cause: Exception) -> T:
        until_s, pauses = time.monotonic() + self._retry_s, pauses_s()
        while not self._is_over and time.monotonic() < until_s:
            time.sleep(next(pauses))
            try:
                return operate()
            except Exception as error:
                told = self._reason(error)
                if told is None:
                    raise
                reason, cause = told, error
        # After one timeout nothing is retried any more: cleanup would take as long again.
        self._is_over = True
        long = f"{self._retry_s:g} s" if self._retry_s < 120 else f"{self._retry_s / 60:g} minutes"
        raise self._error(f"{self._named}, but it has been unavailable for {long}: {reason}") from cause

    @contextmanager
    def _log_outage(self, reason: str) -> Iterator[None]:
        """Log once that threads wait for the service, and once that it is back."""
        with self._changing:
            self._n_waiting += 1
            if self._n_waiting == 1 and not self._is_over:
                log(f"{self._what} is unavailable ({reason}): waiting")
        is_back = True
        try:
            yield
        except (ServiceUnavailableError, KeyboardInterrupt):
            is_back = False
            raise
        finally:
            with self._changing:
                self._n_waiting -= 1
                if self._n_waiting == 0 and is_back:
                    log(f"{self._what} is back")


@contextmanager
def no_retry() -> Iterator[None]:
    """Disable retries in this thread inside the context: `RetryPolicy.call` raises its error at once."""
    before = getattr(_this_thread, "no_retry", False)
    _this_thread.no_retry = True
    try:
        yield
    finally:
        _this_thread.no_retry = before

"""Waiting for a storage that is away for a while: what is lost then, how long is waited, and what is said of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from optuna.exceptions import StorageInternalError
from sqlalchemy.exc import DBAPIError, OperationalError, SQLAlchemyError

from armscan.errors import StorageAwayError
from armscan.sweeps.log import say

T = TypeVar("T")
PATIENCE_S = 600.0
# Between two attempts, at first and at most; each is twice as long as the one before.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 5.0
# What SQLite calls a file that somebody else has locked, or that lies where nothing can be read for now.
AWAY_IN_SQLITE = ("SQLITE_BUSY", "SQLITE_LOCKED", "SQLITE_IOERR")

_this_thread = threading.local()


class ConnectionLostError(Exception):
    """The connection was lost in the middle of a transaction."""


class Patience:
    """Repeats what is asked of a storage while it is away.

    Args:
        uri: of the storage, as it may be shown.
    """

    def __init__(self, uri: str) -> None:
        self._uri = uri
        self._changing = threading.Lock()
        self._n_waiting = 0
        self._is_over = False

    def through(self, operate: Callable[[], T]) -> T:
        """Returns what an operation returns, once the storage is there.

        Args:
            operate: may be called several times, also when it was done, and only its answer was lost.

        Raises:
            StorageAwayError: if the storage stays away for `PATIENCE_S`, or this thread is `impatient`.
        """
        try:
            return operate()
        except Exception as error:
            if not is_away(error):
                raise
            away = error
        if getattr(_this_thread, "is_impatient", False):
            raise StorageAwayError(f"study.storage is {self._uri!r}, but it is away: {_reason(away)}") from away
        with self._told(away):
            return self._waited(operate, away)

    def _waited(self, operate: Callable[[], T], away: Exception) -> T:
        until_s, pause_s = time.monotonic() + PATIENCE_S, FIRST_PAUSE_S
        while not self._is_over and time.monotonic() < until_s:
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            try:
                return operate()
            except Exception as error:
                if not is_away(error):
                    raise
                away = error
        # Nobody waits any more after one has: what is cleared up on the way out would take as long again.
        self._is_over = True
        raise StorageAwayError(
            f"study.storage is {self._uri!r}, but it has been away for {PATIENCE_S / 60:g} minutes: {_reason(away)}"
        ) from away

    @contextmanager
    def _told(self, away: Exception) -> Iterator[None]:
        """Says once that it is waited, and once that it is over, however many threads wait."""
        with self._changing:
            self._n_waiting += 1
            if self._n_waiting == 1 and not self._is_over:
                say(f"the storage is away ({_reason(away)}): waiting")
        is_back = True
        try:
            yield
        except (StorageAwayError, KeyboardInterrupt):
            is_back = False
            raise
        finally:
            with self._changing:
                self._n_waiting -= 1
                if self._n_waiting == 0 and is_back:
                    say("the storage is back")


@contextmanager
def impatient() -> Iterator[None]:
    """What a thread is in that waits for no storage, but is told by a `StorageAwayError`."""
    before = getattr(_this_thread, "is_impatient", False)
    _this_thread.is_impatient = True
    try:
        yield
    finally:
        _this_thread.is_impatient = before


def is_away(error: BaseException | None) -> bool:
    """Whether an error says that a storage cannot be reached for now, and not that what it was told is wrong."""
    # Optuna wraps errors, and may have asked again on a connection that was lost: the first one says why.
    while isinstance(error, StorageInternalError | SQLAlchemyError) and not isinstance(error, DBAPIError):
        error = error.__cause__ or error.__context__
    if not isinstance(error, DBAPIError):
        return isinstance(error, ConnectionLostError)
    in_sqlite = getattr(error.orig, "sqlite_errorname", None)
    if in_sqlite is not None:
        return str(in_sqlite).startswith(AWAY_IN_SQLITE)
    return error.connection_invalidated or isinstance(error, OperationalError)


def _reason(error: BaseException) -> str:
    while not isinstance(error, DBAPIError) and (cause := error.__cause__ or error.__context__) is not None:
        error = cause
    told = str(error.orig if isinstance(error, DBAPIError) else error).strip()
    return told.splitlines()[0] if told else type(error).__name__

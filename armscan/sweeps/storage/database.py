"""Studies in SQLite or PostgreSQL: transactions, locks, and retries while the database is unavailable."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar

from optuna.distributions import BaseDistribution
from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, RDBStorage
from optuna.storages._cached_storage import _CachedStorage
from sqlalchemy import URL, Connection, create_engine, inspect, text
from sqlalchemy.exc import DBAPIError, OperationalError, SQLAlchemyError

from armscan.config.credentials import STORAGE_PASSWORD, database_url
from armscan.errors import StorageUnavailableError
from armscan.sweeps.storage.checked_reads import CheckedReads
from armscan.utils.retry import RetryPolicy

T = TypeVar("T")
NO_SAVEPOINT = "no such savepoint"
# SQLite's errors for a file that another process has locked, that is temporarily unreadable, or whose disk is full.
UNAVAILABLE_IN_SQLITE = ("SQLITE_BUSY", "SQLITE_LOCKED", "SQLITE_IOERR", "SQLITE_FULL")
# Key of the advisory lock in a PostgreSQL database.
ADVISORY_LOCK = 0xA235CA
# How long a lost machine holds the lock, until the database closes its connection.
SILENT_S = 120
# When a silent connection counts as lost: times in seconds, a number of probes, and the last time in milliseconds.
TCP = {
    "connect_timeout": 10,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 25_000,
}


class ConnectionLostError(Exception):
    """The connection was lost in the middle of a transaction."""


def unavailable_reason(error: BaseException) -> str | None:
    """Return why a database is temporarily unavailable; None if the error means something else."""
    is_unavailable = isinstance(error, ConnectionLostError)
    # Optuna wraps errors, and may have retried on a lost connection: the first error has the cause.
    while isinstance(error, ConnectionLostError | StorageInternalError | SQLAlchemyError | sqlite3.Error):
        cause = error.__cause__ or error.__context__
        # On some errors SQLite itself rolls back the transaction, and its savepoints no longer exist.
        if cause is None or (isinstance(error, DBAPIError) and NO_SAVEPOINT not in str(error.orig)):
            break
        error = cause
    if isinstance(error, DBAPIError):
        in_sqlite = getattr(error.orig, "sqlite_errorname", None)
        if in_sqlite is None:
            is_unavailable |= error.connection_invalidated or isinstance(error, OperationalError)
        else:
            is_unavailable |= str(in_sqlite).startswith(UNAVAILABLE_IN_SQLITE)
    if not is_unavailable:
        return None
    message = str(error.orig if isinstance(error, DBAPIError) else error).strip()
    return message.splitlines()[0] if message else type(error).__name__


class _CheckedStorage(CheckedReads, _CachedStorage):
    """A cache of a database that checks all data it reads."""


class DatabaseStorage(_CheckedStorage):
    """An Optuna storage in a database; each call is retried while the database is unavailable.

    A call may be repeated although it succeeded and only its reply was lost: a value is set again, and a new trial that
    no worker knows of has no lease and is reclaimed. A state is set within a transaction, which reads it first.
    """

    def __init__(self, database: RDBStorage, retry_policy: RetryPolicy) -> None:
        super().__init__(database)
        self._retry_policy = retry_policy
        # Per thread: `inside`, the storage of its current transaction, and `known`, that of the one before.
        self._here = threading.local()

    def set_trial_param(self, trial_id: int, name: str, value: float, distribution: BaseDistribution) -> None:
        """See `BaseStorage`."""
        # A cache refuses trials that it has not seen, such as one just claimed through another cache.
        self.transaction(partial(self._backend.set_trial_param, trial_id, name, value, distribution))

    def transaction(self, operate: Callable[[], T], *, is_exclusive: bool = False) -> T:
        """Run an operation in one transaction; repeat it if the database becomes unavailable midway.

        Args:
            operate: Function that reads and writes through this storage, in this thread.
            is_exclusive: Whether to hold the lock of a PostgreSQL database. Default: False.

        Returns:
            The result of the operation.
        """
        if hasattr(self._here, "inside"):
            return operate()
        return self._retry_policy.call(partial(self._in_transaction, operate, is_exclusive))

    def _in_transaction(self, operate: Callable[[], T], is_exclusive: bool) -> T:
        # One transaction on one connection holds the lock and all writes: a lost connection loses both, and leaves
        # nothing half done. If it is lost during the commit, all or nothing was written: a repeated operation checks.
        sessions = self._backend.scoped_session
        # A transaction has its own cache, which the next one reuses unless this one is rolled back.
        inside = self._here.__dict__.pop("known", None) or _CheckedStorage(self._backend)
        with self._backend.engine.connect() as connection:
            try:
                with connection.begin():
                    if is_exclusive:
                        _lock(connection)
                    sessions.remove()
                    # Optuna's commits in this thread are savepoints of the transaction.
                    sessions(bind=connection, join_transaction_mode="create_savepoint")
                    self._here.inside = inside
                    try:
                        done = operate()
                    finally:
                        del self._here.inside
                        sessions.remove()
            except Exception as error:
                if connection.invalidated:
                    raise ConnectionLostError from error
                raise
        self._here.known = inside
        return done


def _retried(name: str, own: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method of `BaseStorage` that is retried; inside a transaction, the whole transaction is instead."""

    @wraps(own)
    def call(self: DatabaseStorage, *args: Any, **kwargs: Any) -> Any:
        if hasattr(self._here, "inside"):
            return getattr(self._here.inside, name)(*args, **kwargs)
        return self._retry_policy.call(partial(own, self, *args, **kwargs))

    return call


for _name in BaseStorage.__abstractmethods__ - {"set_trial_param"}:
    setattr(DatabaseStorage, _name, _retried(_name, getattr(DatabaseStorage, _name)))


def open_database(uri: str, *, retry: bool = False) -> DatabaseStorage:
    """Open a database, and create its tables if there are none; with `retry`, wait while it is unavailable."""
    logging.getLogger("alembic").setLevel(logging.WARNING)
    retry_policy = RetryPolicy("the storage", f"study.storage is {uri!r}", unavailable_reason, StorageUnavailableError)
    opened = partial(_opened, database_url(uri, STORAGE_PASSWORD))
    return DatabaseStorage(retry_policy.call(opened) if retry else opened(), retry_policy)


def create_tables(file: Path) -> None:
    """Create Optuna's tables in a new SQLite file."""
    RDBStorage(URL.create("sqlite", database=str(file)).render_as_string()).engine.dispose()


def tables_in(url: URL) -> list[str]:
    """Return the names of the tables of a database."""
    engine = create_engine(url, connect_args=_options(url))
    try:
        return inspect(engine).get_table_names()
    finally:
        engine.dispose()


def _options(url: URL) -> dict[str, int]:
    return TCP if url.get_backend_name() == "postgresql" else {}


def _opened(url: URL) -> RDBStorage:
    opened = partial(
        RDBStorage,
        url.render_as_string(hide_password=False),
        engine_kwargs={"pool_pre_ping": True, "connect_args": _options(url)},
    )
    if url.get_backend_name() != "postgresql":
        return opened()
    engine = create_engine(url, connect_args=TCP)
    try:
        # Processes that create the tables of an empty database at the same time would conflict.
        with engine.begin() as connection:
            _lock(connection)
            return opened()
    finally:
        engine.dispose()


def _lock(connection: Connection) -> None:
    """Wait for the lock of a database; it is released when the transaction ends, even if this process dies."""
    connection.execute(text(f"SET LOCAL idle_in_transaction_session_timeout = '{SILENT_S}s'"))
    connection.execute(text(f"SELECT pg_advisory_xact_lock({ADVISORY_LOCK})"))

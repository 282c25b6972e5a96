"""Studies in SQLite or PostgreSQL: transactions, locks, and retries while the database is away."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar, cast

from optuna.distributions import BaseDistribution
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.storages import BaseStorage, RDBStorage, get_storage
from optuna.trial import TrialState
from sqlalchemy import URL, Connection, create_engine, inspect, text
from sqlalchemy.exc import DBAPIError, OperationalError, SQLAlchemyError

from armscan.config.credentials import STORAGE_PASSWORD, database_url
from armscan.errors import StorageAwayError
from armscan.utils.retry import RetryPolicy

# Of a SQLite file that another process has locked, or that cannot be read for now.
AWAY_IN_SQLITE = ("SQLITE_BUSY", "SQLITE_LOCKED", "SQLITE_IOERR")


class ConnectionLostError(Exception):
    """The connection was lost in the middle of a transaction."""


def why_away(error: BaseException) -> str | None:
    """Return why a database cannot be reached for now; None if the error is another."""
    return _reason(error) if is_away(error) else None


def is_away(error: BaseException | None) -> bool:
    """Whether an error says that a storage cannot be reached for now, not that the request is wrong."""
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
    message = str(error.orig if isinstance(error, DBAPIError) else error).strip()
    return message.splitlines()[0] if message else type(error).__name__


T = TypeVar("T")
# One of a PostgreSQL database's advisory locks.
ADVISORY_LOCK = 0xA235CA
# A lost machine holds the lock for so long, until its connection is closed.
SILENT_S = 120
# When a connection counts as lost on which nothing comes back: in seconds, but for the last one, in milliseconds.
TCP = {
    "connect_timeout": 10,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 25_000,
}


def url_of(uri: str) -> URL:
    """Return the address of a database with its driver and password."""
    return database_url(uri, STORAGE_PASSWORD)


class DatabaseStorage:
    """An Optuna storage in a database; each call is retried while the database is away.

    A call may be repeated although it was done and only its answer was lost: a value is set again, and a new trial that
    no worker knows has no lease and is reclaimed.

    Args:
        url: of the database.
        retry_policy: for a database that is away.
        retry: whether to wait for it while opening it.
        is_made: whether to create the tables if there are none.
    """

    def __init__(self, url: URL, retry_policy: RetryPolicy, *, retry: bool, is_made: bool) -> None:
        self._retry_policy = retry_policy
        opened = partial(_opened, url, is_made=is_made)
        self._rdb = retry_policy.call(opened) if retry else opened()
        self._cached = get_storage(self._rdb)
        # Of each thread: `inside`, the storage of its current transaction, and `known`, that of the one before.
        self._here = threading.local()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if (inside := getattr(self._here, "inside", None)) is not None:
            return getattr(inside, name)
        return partial(self._call, getattr(self._cached, name))

    def set_trial_param(self, trial_id: int, name: str, value: float, distribution: BaseDistribution) -> None:
        """See `BaseStorage`."""
        # The cache refuses trials that it has not seen, such as one that was claimed a moment ago in a transaction.
        self._call(self._rdb.set_trial_param, trial_id, name, value, distribution)

    def set_trial_state_values(self, trial_id: int, state: TrialState, values: Sequence[float] | None = None) -> bool:
        """See `BaseStorage`."""
        storage, n_calls = getattr(self._here, "inside", None) or self._cached, 0

        def is_set() -> bool:
            nonlocal n_calls
            n_calls += 1
            try:
                return storage.set_trial_state_values(trial_id, state, values)
            except UpdateFinishedTrialError:
                # Others end a worker's trial only as failed: it was this worker, and the answer was lost.
                if n_calls > 1 and storage.get_trial(trial_id).state == state:
                    return True
                raise

        return bool(self._call(is_set))

    def exclusive(self, decide: Callable[[], T]) -> T:
        """See `Storage.exclusive`; for a database that has a lock."""
        return self._retry_policy.call(partial(self._in_transaction, decide, is_alone=True))

    def transaction(self, operate: Callable[[], T]) -> T:
        """See `Storage.transaction`; for a database that has transactions of several statements."""
        if getattr(self._here, "inside", None) is not None:
            return operate()
        return self._retry_policy.call(partial(self._in_transaction, operate, is_alone=False))

    def _in_transaction(self, decide: Callable[[], T], *, is_alone: bool) -> T:
        # One transaction on one connection holds the lock and all writes: a lost connection loses both, and leaves
        # nothing half done. If it is lost during the commit, all or nothing was written: a repeated operation looks.
        sessions = self._rdb.scoped_session
        # A transaction has a cache of its own, which is kept unless it is rolled back.
        inside = getattr(self._here, "known", None) or get_storage(self._rdb)
        self._here.known = None
        with self._rdb.engine.connect() as connection:
            try:
                with connection.begin():
                    if is_alone:
                        _lock(connection)
                    sessions.remove()
                    # Optuna's commits in this thread are savepoints of the transaction.
                    sessions(bind=connection, join_transaction_mode="create_savepoint")
                    self._here.inside = inside
                    try:
                        decided = decide()
                    finally:
                        self._here.inside = None
                        sessions.remove()
            except Exception as error:
                if connection.invalidated:
                    raise ConnectionLostError from error
                raise
        self._here.known = inside
        return decided

    def _call(self, operate: Callable[..., T], *args: Any, **kwargs: Any) -> T:
        if getattr(self._here, "inside", None) is not None:
            # The lock went with the connection: only the whole transaction may be repeated.
            return operate(*args, **kwargs)
        return self._retry_policy.call(partial(operate, *args, **kwargs))


BaseStorage.register(DatabaseStorage)


def open_database(url: URL, shown: str, *, retry: bool, is_made: bool = True) -> BaseStorage:
    """Open a database.

    Args:
        url: of the database.
        shown: the same, without a password.
        retry: whether to wait for it.
        is_made: whether to create the tables if there are none.
    """
    retry_policy = RetryPolicy("the storage", f"study.storage is {shown!r}", why_away, StorageAwayError)
    opened = DatabaseStorage(url, retry_policy, retry=retry, is_made=is_made)
    return cast(BaseStorage, opened)


def tables_in(url: URL) -> list[str]:
    """Return the names of the tables of a database."""
    engine = create_engine(url, connect_args=TCP if url.get_backend_name() == "postgresql" else {})
    try:
        return inspect(engine).get_table_names()
    finally:
        engine.dispose()


def _opened(url: URL, *, is_made: bool) -> RDBStorage:
    options: dict[str, Any] = {"pool_pre_ping": True}
    uri = url.render_as_string(hide_password=False)
    if url.get_backend_name() != "postgresql":
        return RDBStorage(uri, engine_kwargs=options, skip_table_creation=not is_made)
    options["connect_args"] = TCP
    engine = create_engine(url, connect_args=TCP)
    try:
        # Processes that make the tables of an empty database at once get into each other's way.
        with engine.begin() as connection:
            _lock(connection)
            return RDBStorage(uri, engine_kwargs=options, skip_table_creation=not is_made)
    finally:
        engine.dispose()


def _lock(connection: Connection) -> None:
    """Wait for the lock of a database; it is freed when the transaction ends, also by the death of this process."""
    connection.execute(text(f"SET LOCAL idle_in_transaction_session_timeout = '{SILENT_S}s'"))
    connection.execute(text(f"SELECT pg_advisory_xact_lock({ADVISORY_LOCK})"))

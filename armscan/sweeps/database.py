"""Studies in a database, SQLite or PostgreSQL: opened, locked, and waited for where it is away."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar, cast

from optuna.distributions import BaseDistribution
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import BaseStorage, RDBStorage, get_storage
from optuna.trial import TrialState
from sqlalchemy import URL, Connection, create_engine, inspect, text

from armscan.errors import StorageAwayError
from armscan.passwords import STORAGE_PASSWORD, database_url
from armscan.patience import Patience
from armscan.sweeps.away import ConnectionLostError, why_away

T = TypeVar("T")
# One of a PostgreSQL database's advisory locks.
ADVISORY_LOCK = 0xA235CA
# Whoever holds it and is not heard of for so long, because its machine is gone, loses it with its connection.
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
    """Returns the address of a database with its driver and password."""
    return database_url(uri, STORAGE_PASSWORD)


class DatabaseStorage:
    """A storage of Optuna in a database, which may be away for a while: then what is asked of it waits.

    All that Optuna asks may be asked twice, also where it was done and only the answer was lost. What is set has the
    same value again; a new trial that nobody heard of has no lease, and is reclaimed.

    Args:
        url: of the database.
        patience: with it.
        is_patient: whether it is waited for already while it is opened.
        is_made: whether the tables are made where there are none.
    """

    def __init__(self, url: URL, patience: Patience, *, is_patient: bool, is_made: bool) -> None:
        self._patience = patience
        opened = partial(_opened, url, is_made=is_made)
        self._rdb = patience.through(opened) if is_patient else opened()
        self._cached = get_storage(self._rdb)
        # Of each thread: the storage as the transaction sees it that it is in, and what it knows from those before.
        self._here = threading.local()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if (inside := getattr(self._here, "inside", None)) is not None:
            return getattr(inside, name)
        return partial(self._asked, getattr(self._cached, name))

    def set_trial_param(self, trial_id: int, name: str, value: float, distribution: BaseDistribution) -> None:
        """See `BaseStorage`."""
        # The cache refuses trials that it has not seen, such as one that was claimed a moment ago in a transaction.
        self._asked(self._rdb.set_trial_param, trial_id, name, value, distribution)

    def set_trial_state_values(self, trial_id: int, state: TrialState, values: Sequence[float] | None = None) -> bool:
        """See `BaseStorage`."""
        storage, n_asked = getattr(self._here, "inside", None) or self._cached, 0

        def is_set() -> bool:
            nonlocal n_asked
            n_asked += 1
            try:
                return storage.set_trial_state_values(trial_id, state, values)
            except UpdateFinishedTrialError:
                # Others end the trial of a worker only as failed: it was this one, and the answer was lost.
                if n_asked > 1 and storage.get_trial(trial_id).state == state:
                    return True
                raise

        return bool(self._asked(is_set))

    def alone(self, decide: Callable[[], T]) -> T:
        """See `Storage.alone`; for a database that has a lock."""
        return self._patience.through(partial(self._at_once, decide, is_alone=True))

    def together(self, operate: Callable[[], T]) -> T:
        """See `Storage.together`; for a database that has transactions of several statements."""
        if getattr(self._here, "inside", None) is not None:
            return operate()
        return self._patience.through(partial(self._at_once, operate, is_alone=False))

    def _at_once(self, decide: Callable[[], T], *, is_alone: bool) -> T:
        # One transaction on one connection holds the lock and all that is decided. So nothing is done without the lock:
        # who loses the connection loses both, and nothing is left half done. Only whether it was all done or nothing is
        # not known where the connection is lost while it is committed; whoever decides again looks first.
        sessions = self._rdb.scoped_session
        # A transaction has a cache of its own, because what it reads may yet be undone; it is kept when it is not.
        inside = getattr(self._here, "known", None) or get_storage(self._rdb)
        self._here.known = None
        with self._rdb.engine.connect() as connection:
            try:
                with connection.begin():
                    if is_alone:
                        _lock(connection)
                    sessions.remove()
                    # What Optuna commits in this thread are savepoints of the transaction.
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

    def _asked(self, operate: Callable[..., T], *args: Any, **kwargs: Any) -> T:
        if getattr(self._here, "inside", None) is not None:
            # The lock went with the connection: nothing is asked once more before the lock is held again.
            return operate(*args, **kwargs)
        return self._patience.through(partial(operate, *args, **kwargs))


BaseStorage.register(DatabaseStorage)


def open_database(url: URL, shown: str, *, is_patient: bool, is_made: bool = True) -> BaseStorage:
    """Opens a database.

    Args:
        url: of the database.
        shown: the same, as it may be shown.
        is_patient: whether to wait for it.
        is_made: whether the tables are made where there are none.
    """
    patience = Patience("the storage", f"study.storage is {shown!r}", why_away, StorageAwayError)
    opened = DatabaseStorage(url, patience, is_patient=is_patient, is_made=is_made)
    return cast(BaseStorage, opened)


def tables_in(url: URL) -> list[str]:
    """Returns the names of the tables of a database."""
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
    """Waits for the lock of a database; it is freed when the transaction ends, also by the death of this process."""
    connection.execute(text(f"SET LOCAL idle_in_transaction_session_timeout = '{SILENT_S}s'"))
    connection.execute(text(f"SELECT pg_advisory_xact_lock({ADVISORY_LOCK})"))

"""Where a study is kept: a journal file, with nothing to start, or a database."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import optuna
from filelock import FileLock
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from sqlalchemy import create_engine, inspect, text
from sqlalchemy.exc import SQLAlchemyError

from armscan.errors import StudyError
from armscan.sweeps.journal import open_journal, read_journal

SQLITE_PREFIX = "sqlite:///"
# One of a PostgreSQL database's advisory locks.
ADVISORY_LOCK = 0xA235CA
# One of the tables of Optuna.
A_TABLE = "studies"
MAX_REASON_CHARS = 300


@dataclass(frozen=True)
class Storage:
    """A storage that several processes use at once.

    Args:
        uri: where it is, without a password.
        optuna: the storage, for Optuna.
        lock_file: of the few things that only one process may do at a time; None where the database has a lock.
    """

    uri: str
    optuna: BaseStorage = field(repr=False)
    lock_file: Path | None

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Keeps all other processes out while something is decided; short, because they wait."""
        if self.lock_file is not None:
            with FileLock(self.lock_file):
                yield
            return
        assert isinstance(self.optuna, RDBStorage)
        with self.optuna.engine.connect() as connection, connection.begin():
            # Freed when the transaction ends, also by the death of this process.
            connection.execute(text(f"SELECT pg_advisory_xact_lock({ADVISORY_LOCK})"))
            yield


def open_storage(uri: str, *, where: str = "study.storage") -> Storage:
    """Opens a storage, and makes one where there is none.

    Args:
        uri: the path of a journal file, `sqlite:///FILE`, or the URL of a PostgreSQL database.
        where: the user has given it, for messages.

    Raises:
        StudyError: if it cannot be reached or used.
    """
    if is_journal(_checked(uri, where)):
        path = Path(uri).absolute()
        return _in_journal(path, open_journal(path, where))
    return _open_database(uri, where)


def existing_storage(uri: str, *, where: str = "study.storage") -> Storage | None:
    """Opens a storage to look at, None where there is none; nothing is made, mended or locked.

    Args:
        uri: see `open_storage`.
        where: likewise.

    Raises:
        StudyError: if it cannot be reached or used.
    """
    if is_journal(_checked(uri, where)):
        path = Path(uri).absolute()
        return _in_journal(path, read_journal(path, where)) if _is_there(path, where) else None
    return _existing_database(uri, where)


def is_journal(uri: str) -> bool:
    """Whether an address is that of a journal file."""
    return "://" not in uri


def _is_there(path: Path, where: str) -> bool:
    """Whether there is a file; refused, where none could be."""
    above = next(each for each in path.parents if each.exists())
    if path.is_dir() or not above.is_dir():
        raise StudyError(f"{where} is {str(path)!r}, but no file can be used there")
    return path.is_file()


def _in_journal(path: Path, journal: JournalStorage) -> Storage:
    return Storage(str(path), journal, path.with_name(f".{path.name}.alone"))


def _checked(uri: Any, where: str) -> str:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    if not isinstance(uri, str) or not uri.strip() or "\0" in uri:
        raise StudyError(f"{where} is {uri!r}, but it must be a file, or the URL of a database")
    return uri


def _open_database(uri: str, where: str) -> Storage:
    database = _Database.of(uri, where)
    with database.refused_in_one_line():
        if database.lock_file is None:
            return database.storage()
        database.lock_file.parent.mkdir(parents=True, exist_ok=True)
        # Processes that make the tables of a fresh file at once get into each other's way.
        with FileLock(database.lock_file):
            return database.storage()


def _existing_database(uri: str, where: str) -> Storage | None:
    database = _Database.of(uri, where)
    with database.refused_in_one_line():
        if uri.startswith(SQLITE_PREFIX) and not _is_there(Path(uri.removeprefix(SQLITE_PREFIX)).absolute(), where):
            return None
        engine = create_engine(database.uri, **database.options)
        is_there = inspect(engine).has_table(A_TABLE)
        engine.dispose()
        return database.storage(skip_table_creation=True) if is_there else None


@dataclass(frozen=True)
class _Database:
    """A database, before it is opened.

    Args:
        where: its address was given.
        uri: its address.
        lock_file: see `Storage`.
        options: of the connections.
    """

    where: str
    uri: str
    lock_file: Path | None
    options: Mapping[str, Any]

    @classmethod
    def of(cls, uri: str, where: str) -> Self:
        """Returns the one at an address."""
        logging.getLogger("alembic").setLevel(logging.WARNING)
        if uri.startswith(SQLITE_PREFIX):
            file = Path(uri.removeprefix(SQLITE_PREFIX)).absolute()
            lock_file = file.with_name(f".{file.name}.alone")
            return cls(where, f"{SQLITE_PREFIX}{file}", lock_file, {"pool_pre_ping": True})
        if uri.startswith("postgresql"):
            options = {"pool_pre_ping": True, "connect_args": {"connect_timeout": 10}}
            return cls(where, uri, None, options)
        shown = without_password(uri)
        raise StudyError(f"{where} is {shown!r}, but it must be a file, sqlite:///FILE or postgresql://...")

    def storage(self, **options: Any) -> Storage:
        """Returns the storage in it."""
        opened = RDBStorage(self.uri, engine_kwargs=dict(self.options), **options)
        return Storage(without_password(self.uri), opened, self.lock_file)

    @contextlib.contextmanager
    def refused_in_one_line(self) -> Iterator[None]:
        """Answers what comes of a database that cannot be used."""
        try:
            yield
        except (SQLAlchemyError, OSError, ImportError, RuntimeError) as error:
            shown = without_password(self.uri)
            reason = " ".join(str(error).split()).replace(self.uri, shown)[:MAX_REASON_CHARS]
            raise StudyError(f"{self.where} is {shown!r}, but this storage cannot be used: {reason}") from error


def without_password(uri: str) -> str:
    """Returns an address as it may be shown."""
    scheme, separator, rest = uri.partition("://")
    account, at, host = rest.rpartition("@")
    return f"{scheme}{separator}{account.partition(':')[0]}{at}{host}"

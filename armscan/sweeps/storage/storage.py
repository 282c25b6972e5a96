"""The storage of a study: a journal file, which needs no server, or a database."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import optuna
from filelock import FileLock
from optuna.exceptions import StorageInternalError
from optuna.storages import BaseStorage, JournalStorage
from sqlalchemy.exc import SQLAlchemyError

from armscan.config.credentials import check_address, mask_passwords
from armscan.errors import StudyError
from armscan.sweeps.storage.database import DatabaseStorage, open_database, tables_in, url_of
from armscan.sweeps.storage.journal import open_journal, read_journal
from armscan.utils.files import SQLITE_PREFIX, sqlite_file

T = TypeVar("T")
MAX_REASON_CHARS = 300
# Tables of Optuna.
A_TABLE, OTHER_TABLES = "studies", ("trials", "version_info")


@dataclass(frozen=True)
class Storage:
    """A storage that several processes use at once.

    Args:
        uri: where it is, without a password.
        optuna: the storage, for Optuna.
        lock_file: of exclusive operations; None if the database has a lock.
    """

    uri: str
    optuna: BaseStorage = field(repr=False)
    lock_file: Path | None

    def exclusive(self, decide: Callable[[], T]) -> T:
        """Run an operation that excludes all other processes.

        Args:
            decide: short, because the others wait. If the storage goes away in the middle, it is called again when the
                storage is back: then all of its writes are there, or none.

        Returns:
            What it returns.
        """
        if self.lock_file is not None:
            with FileLock(self.lock_file):
                return decide()
        assert isinstance(self.optuna, DatabaseStorage)
        return self.optuna.exclusive(decide)

    def transaction(self, operate: Callable[[], T]) -> T:
        """Run several reads and writes in one transaction, which is one round trip to a database that commits.

        Args:
            operate: asks; see `alone`.

        Returns:
            What it returns.
        """
        if self.lock_file is not None:
            return operate()
        assert isinstance(self.optuna, DatabaseStorage)
        return self.optuna.transaction(operate)


def open_storage(uri: str, *, where: str = "study.storage", retry: bool = False) -> Storage:
    """Open a storage, and create it if there is none.

    Args:
        uri: the path of a journal file, `sqlite:///FILE`, or the URL of a PostgreSQL database.
        where: key that named it, for messages.
        retry: whether to wait for a database that is away while opening it; an open one is always waited for.

    Raises:
        StudyError: if it cannot be reached or used.
    """
    if is_journal(_checked(uri, where)):
        path = Path(uri).absolute()
        return _in_journal(path, open_journal(path, where))
    return _open_database(uri, where, retry=retry)


def existing_storage(uri: str, *, where: str = "study.storage") -> Storage | None:
    """Open a storage to read, None if there is none; nothing is created, repaired or locked.

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
    """Whether there is a file; raises `StudyError` if none could be."""
    above = next(each for each in path.parents if each.exists())
    if (path.exists() and not path.is_file()) or not above.is_dir():
        raise StudyError(f"{where} is {str(path)!r}, but no file can be used there")
    return path.is_file()


def _in_journal(path: Path, journal: JournalStorage) -> Storage:
    return Storage(str(path), journal, _lock_file_of(path))


def _checked(uri: Any, where: str) -> str:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    if not isinstance(uri, str) or not uri.strip() or "\0" in uri:
        raise StudyError(f"{where} is {uri!r}, but it must be a file, or the URL of a database")
    check_address(where, uri)
    return uri


def _open_database(uri: str, where: str, *, retry: bool) -> Storage:
    with _refused_in_one_line(uri, where):
        if not uri.startswith(SQLITE_PREFIX):
            return _in_database(uri, retry=retry)
        file = sqlite_file(uri)
        file.parent.mkdir(parents=True, exist_ok=True)
        # A lock that cannot be made would be waited for for ever.
        _lock_file_of(file).touch()
        # Processes that make the tables of a fresh file at once get into each other's way.
        with FileLock(_lock_file_of(file)):
            _check_is_for_studies(uri)
            return _in_database(uri, retry=retry)


def _existing_database(uri: str, where: str) -> Storage | None:
    with _refused_in_one_line(uri, where):
        if uri.startswith(SQLITE_PREFIX) and not _is_there(sqlite_file(uri), where):
            return None
        _check_is_for_studies(uri)
        return _in_database(uri, is_made=False) if A_TABLE in tables_in(url_of(uri)) else None


def _check_is_for_studies(uri: str) -> None:
    """Raise `ValueError` if a SQLite file holds tables of another program."""
    tables = tables_in(url_of(uri)) if uri.startswith(SQLITE_PREFIX) else []
    if tables and not {A_TABLE, *OTHER_TABLES} <= set(tables):
        raise ValueError(f"it holds other tables, {tables[0]} first: give a file of its own")


def _in_database(uri: str, *, retry: bool = False, is_made: bool = True) -> Storage:
    logging.getLogger("alembic").setLevel(logging.WARNING)
    shown, lock_file = uri, None
    if uri.startswith(SQLITE_PREFIX):
        lock_file = _lock_file_of(sqlite_file(uri))
        uri = f"{SQLITE_PREFIX}{sqlite_file(uri)}"
    return Storage(shown, open_database(url_of(uri), shown, retry=retry, is_made=is_made), lock_file)


def _lock_file_of(file: Path) -> Path:
    return file.with_name(f".{file.name}.alone")


@contextlib.contextmanager
def _refused_in_one_line(uri: str, where: str) -> Iterator[None]:
    """Turn the errors of an unusable database into one line."""
    if not uri.startswith((SQLITE_PREFIX, "postgresql")):
        raise StudyError(f"{where} is {uri!r}, but it must be a file, sqlite:///FILE or postgresql://...")
    try:
        yield
    except StudyError:
        raise
    except ModuleNotFoundError as error:
        raise StudyError(
            f"{where} is {uri!r}, but {error.name} is not installed: pip install 'armscan[postgres]'"
        ) from error
    except (SQLAlchemyError, StorageInternalError, OSError, ImportError, RuntimeError, ValueError) as error:
        reason = mask_passwords(" ".join(str(error).split()))[:MAX_REASON_CHARS]
        raise StudyError(f"{where} is {uri!r}, but this storage cannot be used: {reason}") from error

"""The storage of a study: a journal file, which needs no server, or a database."""

from __future__ import annotations

import contextlib
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import optuna
from filelock import FileLock
from optuna.exceptions import StorageInternalError
from optuna.study import Study
from sqlalchemy.exc import SQLAlchemyError

from armscan.config.credentials import STORAGE_PASSWORD, check_address, database_url, mask_passwords
from armscan.errors import MAX_REASON_CHARS, StorageUnavailableError, StudyError, in_one_line
from armscan.sweeps.storage.database import DatabaseStorage, create_tables, open_database, tables_in
from armscan.sweeps.storage.journal import CheckedJournal, open_journal
from armscan.utils.files import SQLITE_PREFIX, create_database, sqlite_file

T = TypeVar("T")
# Some of Optuna's tables.
TABLES = {"studies", "trials", "version_info"}


@dataclass(frozen=True)
class Storage:
    """A storage that several processes use at once.

    Args:
        uri: Address of the storage, without a password.
        optuna: Storage of Optuna.
        lock_file: Lock file of exclusive operations; None if the database has a lock.
    """

    uri: str
    optuna: DatabaseStorage | CheckedJournal = field(repr=False)
    lock_file: Path | None

    @property
    def study_names(self) -> list[str]:
        """The names of its studies."""
        return optuna.get_all_study_names(self.optuna)

    def study(self, name: str) -> Study | None:
        """Return the study with this name; None if there is none."""
        return optuna.load_study(study_name=name, storage=self.optuna) if name in self.study_names else None

    def exclusive(self, decide: Callable[[], T]) -> T:
        """Run an operation that excludes all other processes, and return its result.

        Args:
            decide: Short operation, because the others wait. If a PostgreSQL database becomes unavailable midway, it is
                called again once the database is back: then all of its writes are there, or none.
        """
        if self.lock_file is None:
            assert isinstance(self.optuna, DatabaseStorage)
            return self.optuna.transaction(decide, is_exclusive=True)
        with FileLock(self.lock_file):
            return decide()

    def transaction(self, operate: Callable[[], T]) -> T:
        """Run several reads and writes, in a PostgreSQL database as one transaction, and return their result.

        Args:
            operate: Function that reads and writes; it may be called again, like `decide` of `exclusive`.
        """
        if self.lock_file is None:
            assert isinstance(self.optuna, DatabaseStorage)
            return self.optuna.transaction(operate)
        return operate()


def open_storage(uri: str, *, where: str = "study.storage", retry: bool = False) -> Storage:
    """Open a storage, and create it if there is none.

    Args:
        uri: Path of a journal file, `sqlite:///FILE`, or the URL of a PostgreSQL database.
        where: Key that named the storage, for messages.
        retry: Whether to wait for an unavailable PostgreSQL database while opening it; calls to an open one are always
            retried. Default: False.

    Raises:
        StudyError: If it cannot be reached or used.
    """
    with _refused_in_one_line(uri, where):
        file = _file_of(uri)
        if file is None:
            return Storage(uri, open_database(uri, retry=retry), None)
        file.parent.mkdir(parents=True, exist_ok=True)
        _is_there(file)
        # Fail now if the lock file cannot be created: the lock would wait forever.
        _lock_file_of(file).touch()
        # Processes that create the tables of a new file at the same time would conflict.
        with FileLock(_lock_file_of(file)):
            if uri.startswith(SQLITE_PREFIX):
                create_database(file, create_tables)
            return _in_file(uri, file, is_written=True)


def existing_storage(uri: str, *, where: str = "study.storage") -> Storage | None:
    """Open a storage to read, named as in `open_storage`; None if there is none. Nothing is created or locked."""
    with _refused_in_one_line(uri, where):
        file = _file_of(uri)
        if file is None:
            return Storage(uri, open_database(uri), None) if _tables(uri) >= TABLES else None
        if not _is_there(file) or (uri.startswith(SQLITE_PREFIX) and not _tables(uri)):
            return None
        return _in_file(uri, file, is_written=False)


def _file_of(uri: str) -> Path | None:
    """Return the file of a storage, None for a PostgreSQL database."""
    return None if uri.startswith("postgresql") else sqlite_file(uri)


def _lock_file_of(file: Path) -> Path:
    return file.with_name(f".{file.name}.alone")


def _is_there(file: Path) -> bool:
    """Return whether there is a file; raise `OSError` if something else is there, or the path cannot be read."""
    try:
        if stat.S_ISREG(file.stat().st_mode):
            return True
    except FileNotFoundError:
        return False
    raise OSError(None, "it is not a regular file")


def _in_file(uri: str, file: Path, *, is_written: bool) -> Storage:
    if not uri.startswith(SQLITE_PREFIX):
        return Storage(str(file), open_journal(file, is_written=is_written), _lock_file_of(file))
    tables = _tables(uri)
    if tables and not tables >= TABLES:
        raise StudyError(f"it holds other tables, {min(tables)} first: give a file of its own")
    return Storage(uri, open_database(f"{SQLITE_PREFIX}{file}"), _lock_file_of(file))


def _tables(uri: str) -> set[str]:
    return set(tables_in(database_url(uri, STORAGE_PASSWORD)))


@contextlib.contextmanager
def _refused_in_one_line(uri: str, where: str) -> Iterator[None]:
    """Turn the errors of an unusable storage into a one-line `StudyError`."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    check_address(where, uri)
    if "://" in uri and not uri.startswith((SQLITE_PREFIX, "postgresql")):
        raise StudyError(f"{where} is {uri!r}, but it must be a file, sqlite:///FILE or postgresql://...")
    try:
        yield
    except StorageUnavailableError:
        raise
    except (SQLAlchemyError, StorageInternalError, OSError, ImportError, RuntimeError, ValueError) as error:
        shown = uri if "://" in uri else str(sqlite_file(uri))
        raise StudyError(f"{where} is {shown!r}, but {_reason(error)}") from error


def _reason(error: Exception) -> str:
    match error:
        case StudyError():
            return str(error)
        case ModuleNotFoundError():
            return f"{error.name} is not installed: pip install 'armscan[postgres]'"
        case OSError():
            return f"no file can be used there ({error.strerror})"
    return "this storage cannot be used: " + mask_passwords(in_one_line(error))[:MAX_REASON_CHARS]

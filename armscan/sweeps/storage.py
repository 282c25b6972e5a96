"""Where a study is kept: a journal file, with nothing to start, or a database."""

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

from armscan.errors import StudyError
from armscan.files import SQLITE_PREFIX, sqlite_file
from armscan.passwords import masked, without_password
from armscan.sweeps.database import DatabaseStorage, open_database, tables_in, url_of
from armscan.sweeps.journal import open_journal, read_journal

T = TypeVar("T")
MAX_REASON_CHARS = 300
# Of the tables of Optuna.
A_TABLE, OTHER_TABLES = "studies", ("trials", "version_info")


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

    def alone(self, decide: Callable[[], T]) -> T:
        """Keeps all other processes out while something is decided.

        Args:
            decide: what is done then; short, because the others wait. Where the storage goes away in the middle, it is
                called again when it is back: then all that it did before is there, or nothing of it.

        Returns:
            What it returns.
        """
        if self.lock_file is not None:
            with FileLock(self.lock_file):
                return decide()
        assert isinstance(self.optuna, DatabaseStorage)
        return self.optuna.alone(decide)

    def together(self, operate: Callable[[], T]) -> T:
        """Asks for several things at once, where there is a way to go for each: one there and back for all of them.

        Args:
            operate: asks; see `alone`.

        Returns:
            What it returns.
        """
        if self.lock_file is not None:
            return operate()
        assert isinstance(self.optuna, DatabaseStorage)
        return self.optuna.together(operate)


def open_storage(uri: str, *, where: str = "study.storage", is_patient: bool = False) -> Storage:
    """Opens a storage, and makes one where there is none.

    Args:
        uri: the path of a journal file, `sqlite:///FILE`, or the URL of a PostgreSQL database.
        where: the user has given it, for messages.
        is_patient: whether to wait for a database that is away; once it is open, it is waited for in any case.

    Raises:
        StudyError: if it cannot be reached or used.
    """
    if is_journal(_checked(uri, where)):
        path = Path(uri).absolute()
        return _in_journal(path, open_journal(path, where))
    return _open_database(uri, where, is_patient=is_patient)


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
    if (path.exists() and not path.is_file()) or not above.is_dir():
        raise StudyError(f"{where} is {str(path)!r}, but no file can be used there")
    return path.is_file()


def _in_journal(path: Path, journal: JournalStorage) -> Storage:
    return Storage(str(path), journal, _lock_file_of(path))


def _checked(uri: Any, where: str) -> str:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    if not isinstance(uri, str) or not uri.strip() or "\0" in uri:
        raise StudyError(f"{where} is {uri!r}, but it must be a file, or the URL of a database")
    return uri


def _open_database(uri: str, where: str, *, is_patient: bool) -> Storage:
    with _refused_in_one_line(uri, where):
        if not uri.startswith(SQLITE_PREFIX):
            return _in_database(uri, is_patient=is_patient)
        file = sqlite_file(uri)
        file.parent.mkdir(parents=True, exist_ok=True)
        # A lock that cannot be made would be waited for for ever.
        _lock_file_of(file).touch()
        # Processes that make the tables of a fresh file at once get into each other's way.
        with FileLock(_lock_file_of(file)):
            _check_is_for_studies(uri)
            return _in_database(uri, is_patient=is_patient)


def _existing_database(uri: str, where: str) -> Storage | None:
    with _refused_in_one_line(uri, where):
        if uri.startswith(SQLITE_PREFIX) and not _is_there(sqlite_file(uri), where):
            return None
        _check_is_for_studies(uri)
        return _in_database(uri, is_made=False) if A_TABLE in tables_in(url_of(uri)) else None


def _check_is_for_studies(uri: str) -> None:
    """Raises `ValueError` where a file of SQLite is somebody else's."""
    tables = tables_in(url_of(uri)) if uri.startswith(SQLITE_PREFIX) else []
    if tables and not {A_TABLE, *OTHER_TABLES} <= set(tables):
        raise ValueError(f"it holds other tables, {tables[0]} first: give a file of its own")


def _in_database(uri: str, *, is_patient: bool = False, is_made: bool = True) -> Storage:
    logging.getLogger("alembic").setLevel(logging.WARNING)
    shown, lock_file = without_password(uri), None
    if uri.startswith(SQLITE_PREFIX):
        lock_file = _lock_file_of(sqlite_file(uri))
        uri = f"{SQLITE_PREFIX}{sqlite_file(uri)}"
    return Storage(shown, open_database(url_of(uri), shown, is_patient=is_patient, is_made=is_made), lock_file)


def _lock_file_of(file: Path) -> Path:
    return file.with_name(f".{file.name}.alone")


@contextlib.contextmanager
def _refused_in_one_line(uri: str, where: str) -> Iterator[None]:
    """Answers what comes of a database that cannot be used."""
    shown = without_password(uri)
    if not uri.startswith((SQLITE_PREFIX, "postgresql")):
        raise StudyError(f"{where} is {shown!r}, but it must be a file, sqlite:///FILE or postgresql://...")
    try:
        yield
    except StudyError:
        raise
    except ModuleNotFoundError as error:
        raise StudyError(
            f"{where} is {shown!r}, but {error.name} is not installed: pip install 'armscan[postgres]'"
        ) from error
    except (SQLAlchemyError, StorageInternalError, OSError, ImportError, RuntimeError, ValueError) as error:
        reason = masked(" ".join(str(error).split()).replace(uri, shown))[:MAX_REASON_CHARS]
        raise StudyError(f"{where} is {shown!r}, but this storage cannot be used: {reason}") from error

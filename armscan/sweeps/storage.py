"""Where a study is kept: a journal file, with nothing to start, or a database."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import optuna
from filelock import FileLock
from optuna.storages import BaseStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from sqlalchemy.exc import SQLAlchemyError

from armscan.checks import check_path
from armscan.errors import StorageAwayError, StudyError
from armscan.sweeps.database import DatabaseStorage, open_database, url_of

T = TypeVar("T")
SQLITE_PREFIX = "sqlite:///"
BLOCK_BYTES = 4096


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


def open_storage(uri: str, *, is_patient: bool = False) -> Storage:
    """Opens a storage, and makes one where there is none.

    Args:
        uri: the path of a journal file, `sqlite:///FILE`, or the URL of a PostgreSQL database.
        is_patient: whether to wait for a database that is away; once it is open, it is waited for in any case.

    Raises:
        StudyError: if it cannot be reached or used.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    if not isinstance(uri, str) or not uri.strip():
        raise StudyError(f"study.storage is {uri!r}, but it must be a file, or the URL of a database")
    if "://" not in uri:
        return _open_journal(check_path("study.storage", uri))
    return _open_database(uri, is_patient=is_patient)


def _open_journal(path: Path) -> Storage:
    path = path.absolute()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        # Before anything is mended: any other file would lose what stands behind its last line's end.
        with path.open("rb") as file:
            first_line = file.readline(BLOCK_BYTES)
        if not _begins_a_journal(first_line):
            raise StudyError(f"study.storage is {str(path)!r}, but that file is no journal of Optuna")
        lock = JournalLock(path)
        lock.acquire()
        lock.release()
        backend = JournalFileBackend(str(path), lock_obj=lock)
        return Storage(str(path), JournalStorage(backend), path.with_name(f".{path.name}.alone"))
    except OSError as error:
        raise StudyError(f"study.storage is {str(path)!r}, but no file can be used there ({error.strerror})") from error
    # What Optuna raises for a line that it cannot read, whichever way it is damaged.
    except (ValueError, KeyError, AssertionError) as error:
        raise StudyError(f"study.storage is {str(path)!r}, but that file is no journal of Optuna: {error}") from error


def _begins_a_journal(line: bytes) -> bool:
    """Whether this is the first line of a journal, which may be empty, or torn in its first line."""
    return not line or (line.startswith(b"{") and (b'"op_code"' in line or not line.endswith(b"\n")))


def _open_database(uri: str, *, is_patient: bool) -> Storage:
    shown = without_password(uri)
    if not uri.startswith((SQLITE_PREFIX, "postgresql")):
        raise StudyError(f"study.storage is {shown!r}, but it must be a file, sqlite:///FILE or postgresql://...")
    logging.getLogger("alembic").setLevel(logging.WARNING)
    try:
        if not uri.startswith(SQLITE_PREFIX):
            return Storage(shown, open_database(url_of(uri), shown, is_patient=is_patient), None)
        database = Path(uri.removeprefix(SQLITE_PREFIX)).absolute()
        database.parent.mkdir(parents=True, exist_ok=True)
        lock_file = database.with_name(f".{database.name}.alone")
        # Processes that make the tables of a fresh file at once get into each other's way.
        with FileLock(lock_file):
            url = url_of(f"{SQLITE_PREFIX}{database}")
            return Storage(shown, open_database(url, shown, is_patient=is_patient), lock_file)
    except StorageAwayError:
        raise
    except ModuleNotFoundError as error:
        raise StudyError(
            f"study.storage is {shown!r}, but {error.name} is not installed: pip install 'armscan[postgres]'"
        ) from error
    except (SQLAlchemyError, OSError, ImportError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split()).replace(uri, shown)[:300]
        raise StudyError(f"study.storage is {shown!r}, but this storage cannot be used: {reason}") from error


def without_password(uri: str) -> str:
    """Returns an address as it may be shown."""
    scheme, separator, rest = uri.partition("://")
    account, at, host = rest.rpartition("@")
    shown = f"{scheme}{separator}{account.partition(':')[0]}{at}{host}"
    return re.sub(r"([?&])password=[^&]*&?", r"\1", shown).rstrip("?&")


class JournalLock(JournalFileOpenLock):
    """The lock of a journal file; whoever gets it finds whole lines.

    The system frees it when a process dies, where Optuna's own would make all others wait for 30 s. A line that was
    torn because its writer died is cut off: Optuna would take it for the beginning of the next one, and then nobody
    could read either.

    Args:
        journal: the file.
    """

    def __init__(self, journal: Path) -> None:
        super().__init__(str(journal))
        self._journal = journal
        self._lock = FileLock(journal.with_name(f".{journal.name}.lock"))

    def acquire(self) -> bool:
        """Waits for the lock."""
        self._lock.acquire()
        cut_torn_line(self._journal)
        return True

    def release(self) -> None:
        """Frees it."""
        self._lock.release()


def cut_torn_line(path: Path) -> None:
    """Cuts off what stands behind the last line of a file that has an end."""
    with path.open("rb+") as file:
        size = end = file.seek(0, os.SEEK_END)
        while end > 0:
            start = max(0, end - BLOCK_BYTES)
            file.seek(start)
            newline = file.read(end - start).rfind(b"\n")
            end = start + newline + 1 if newline >= 0 else start
            if newline >= 0:
                break
        if end < size:
            file.truncate(end)

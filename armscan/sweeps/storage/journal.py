"""A study's journal file, the default storage: lines that are appended whole."""

from __future__ import annotations

from pathlib import Path

from filelock import FileLock
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

from armscan.errors import StudyError
from armscan.utils.files import truncate_torn_line

BLOCK_BYTES = 4096


def open_journal(path: Path, where: str) -> JournalStorage:
    """Open a journal to write, create it if there is none, and truncate a torn last line.

    Args:
        path: of the file.
        where: key that named it, for messages.

    Raises:
        StudyError: if no file can be used there, or the one that is there is no journal.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        JournalLock(path).touch()
    except OSError as error:
        raise StudyError(f"{where} is {str(path)!r}, but no file can be used there ({error.strerror})") from error
    # Before the repair, which would damage any other file.
    _check_beginning(path, where)
    lock = JournalLock(path)
    lock.acquire()
    lock.release()
    return read_journal(path, where)


def read_journal(path: Path, where: str) -> JournalStorage:
    """Open a journal that exists, as it is.

    Args:
        path: of the file.
        where: key that named it, for messages.

    Raises:
        StudyError: if it cannot be read, is no journal, or is damaged before its last line.
    """
    _check_beginning(path, where)
    try:
        return JournalStorage(JournalFileBackend(str(path), lock_obj=JournalLock(path)))
    # What Optuna raises for a line that it cannot read, whichever way it is damaged.
    except (ValueError, KeyError, TypeError, AssertionError) as error:
        raise StudyError(f"{where} is {str(path)!r}, but that file is no journal of Optuna: {error}") from error


def _check_beginning(path: Path, where: str) -> None:
    try:
        with path.open("rb") as file:
            first_line = file.readline(BLOCK_BYTES)
    except OSError as error:
        raise StudyError(f"{where} is {str(path)!r}, but that file cannot be read ({error.strerror})") from error
    if not _begins_a_journal(first_line):
        raise StudyError(f"{where} is {str(path)!r}, but that file is no journal of Optuna")


def _begins_a_journal(line: bytes) -> bool:
    """Whether this is the first line of a journal, which may be empty, or torn in its first line."""
    return not line or (line.startswith(b"{") and (b'"op_code"' in line or not line.endswith(b"\n")))


class JournalLock(JournalFileOpenLock):
    """The lock of a journal file; its holder finds whole lines.

    The system frees it when a process dies; Optuna's own lock would block all others for 30 s. A line whose writer died
    is truncated: Optuna would append the next to it, and could read neither.

    Args:
        journal: the file.
    """

    def __init__(self, journal: Path) -> None:
        super().__init__(str(journal))
        self._journal = journal
        self._lock = FileLock(journal.with_name(f".{journal.name}.lock"))

    def touch(self) -> None:
        """Create the lock file: one that cannot be created would be waited for for ever."""
        Path(self._lock.lock_file).touch()

    def acquire(self) -> bool:
        """Wait for the lock."""
        self._lock.acquire()
        truncate_torn_line(self._journal)
        return True

    def release(self) -> None:
        """Free it."""
        self._lock.release()

"""The journal that a study is kept in where nobody names a database: a file of lines, each added whole."""

from __future__ import annotations

import os
from pathlib import Path

from filelock import FileLock
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

from armscan.errors import StudyError

BLOCK_BYTES = 4096


def open_journal(path: Path, where: str) -> JournalStorage:
    """Opens a journal to write in it, makes it where there is none, and cuts off a line that is torn.

    Args:
        path: of the file.
        where: the user has given it, for messages.

    Raises:
        StudyError: if no file can be used there, or the one that is there is no journal.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        JournalLock(path).touch()
    except OSError as error:
        raise StudyError(f"{where} is {str(path)!r}, but no file can be used there ({error.strerror})") from error
    # Before anything is mended: any other file would lose what stands behind its last line's end.
    _check_beginning(path, where)
    lock = JournalLock(path)
    lock.acquire()
    lock.release()
    return read_journal(path, where)


def read_journal(path: Path, where: str) -> JournalStorage:
    """Opens a journal that exists, as it is.

    Args:
        path: of the file.
        where: the user has given it, for messages.

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

    def touch(self) -> None:
        """Makes the file of the lock: one that cannot be made would be waited for for ever."""
        Path(self._lock.lock_file).touch()

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

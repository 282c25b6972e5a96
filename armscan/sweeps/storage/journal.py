"""A study's journal file, the default storage: lines that are appended whole."""

from __future__ import annotations

from pathlib import Path

from filelock import FileLock
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

from armscan.errors import StudyError
from armscan.utils.files import truncate_torn_line

# How every line of a journal begins.
BEGINNING = b'{"op_code"'


def open_journal(path: Path, *, is_written: bool) -> JournalStorage:
    """Open a journal.

    Args:
        path: of the file.
        is_written: whether to create it if there is none, and to truncate a torn last line.

    Raises:
        OSError: if no file can be used there.
        StudyError: if the file is no journal, or is damaged before its last line.
    """
    lock = JournalLock(path)
    if is_written:
        path.touch()
        lock.touch()
    # Before the repair, which would damage any other file. A journal may be empty, or torn in its first line.
    with path.open("rb") as file:
        if not BEGINNING.startswith(file.read(len(BEGINNING))):
            raise StudyError("that file is no journal of Optuna")
    if is_written:
        lock.acquire()
        lock.release()
    try:
        return JournalStorage(JournalFileBackend(str(path), lock_obj=lock))
    # What Optuna raises for a line that it cannot read, whichever way it is damaged.
    except (ValueError, KeyError, TypeError, AssertionError) as error:
        raise StudyError(f"that file is no journal of Optuna: {error}") from error


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

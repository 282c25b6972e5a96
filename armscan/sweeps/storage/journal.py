"""A study's journal file, the default storage: whole lines are appended, each with a checksum of the file so far."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock
from optuna.storages import JournalStorage
from optuna.storages.journal import BaseJournalBackend
from optuna.storages.journal._storage import JournalOperation

from armscan.errors import StorageUnavailableError, StudyError
from armscan.sweeps.storage.attributes import UNREADABLE
from armscan.sweeps.storage.checked_reads import CheckedReads
from armscan.utils.files import FULL_DISK, truncate_torn_line
from armscan.utils.retry import RetryPolicy

# Beginning of each line of a journal.
BEGINNING = b'{"op_code"'
# End of a line: the CRC-32 of the lines before it and of itself up to here. Optuna ignores the key.
SUM = re.compile(rb',"sum":"([0-9a-f]{8})"\}\n$')


def open_journal(path: Path, *, is_written: bool) -> CheckedJournal:
    """Open a journal; if it is to be written, create it if there is none, and remove a torn last line.

    Raises:
        OSError: If no file can be used there.
        StudyError: If the file is not a journal, or a line before the last was lost or changed.
    """
    journal = JournalFile(path)
    if is_written:
        path.touch()
        journal.lock_file.touch()
    # Before the repair, which would damage any other file. A journal may be empty, or torn in its first line.
    with path.open("rb") as file:
        if not BEGINNING.startswith(file.read(len(BEGINNING))):
            raise StudyError("that file is not an Optuna journal")
    if is_written:
        with journal.locked():
            pass
    try:
        return CheckedJournal(journal)
    # Raised for a line that cannot be read.
    except UNREADABLE as error:
        raise StudyError(f"that file is not an Optuna journal: {error}") from error


class CheckedJournal(CheckedReads, JournalStorage):
    """A journal that checks all data it reads."""


def _why_full(error: BaseException) -> str | None:
    return error.strerror if isinstance(error, OSError) and error.errno in FULL_DISK else None


@dataclass(frozen=True)
class Position:
    """A position between two lines of a journal: number, size in bytes and checksum of the lines before it."""

    n_lines: int = 0
    end: int = 0
    sum: int = 0


class JournalFile(BaseJournalBackend):
    """A journal file in which a lost or changed line is noticed, if a line with a checksum follows it.

    Lines that earlier versions or Optuna have appended have no checksum of their own; the next checksum includes them.
    Only the loss of the last lines goes unnoticed: they may never have been written.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._read = path, Position()
        self._n_studies = self._n_trials = 0
        self.lock_file = path.with_name(f".{path.name}.lock")
        self._lock = FileLock(self.lock_file)
        self._retry_policy = RetryPolicy(
            "the storage", f"study.storage is {str(path)!r}", _why_full, StorageUnavailableError
        )

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the lock of the file, which then ends with a whole line.

        The system releases it when a process dies; Optuna's own lock would block all others for 30 s. A torn line,
        whose writer died, is removed: the next one would be appended to it, and neither could be read.
        """
        with self._lock:
            truncate_torn_line(self._path)
            yield

    def read_logs(self, log_number_from: int) -> Iterator[dict[str, Any]]:
        """See `BaseJournalBackend`."""
        if log_number_from != self._read.n_lines:
            self._read, self._n_studies, self._n_trials = Position(), 0, 0
        for line, position in self._lines():
            operation = json.loads(line)
            self._check_references(operation, position.n_lines)
            self._read = position
            if position.n_lines > log_number_from:
                yield operation

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """See `BaseJournalBackend`; retried while the disk is full."""
        self._retry_policy.call(partial(self._append, logs))

    def _append(self, logs: list[dict[str, Any]]) -> None:
        with self.locked():
            # Others may have appended lines since the last read.
            total = [self._read, *(position for _, position in self._lines())][-1].sum
            lines = []
            for operation in logs:
                line = json.dumps(operation, separators=(",", ":")).encode()[:-1]
                total = zlib.crc32(line, total)
                lines.append(b'%b,"sum":"%08x"}\n' % (line, total))
            end = self._path.stat().st_size
            try:
                with self._path.open("ab") as file:
                    file.write(b"".join(lines))
                    file.flush()
                    os.fsync(file.fileno())
            except OSError:
                # On a full disk some lines may have been written: remove them, because all are written again.
                os.truncate(self._path, end)
                raise

    def _lines(self) -> Iterator[tuple[bytes, Position]]:
        """Iterate over the complete lines that have not been read, each with the position after it."""
        position = self._read
        with self._path.open("rb") as file:
            if file.seek(0, os.SEEK_END) < position.end:
                raise self._damaged(position.n_lines)
            file.seek(position.end)
            # All at once: a torn line may be replaced meanwhile.
            unread = file.read()
        for line in io.BytesIO(unread):
            # Its writer has not finished it, or has died.
            if not line.endswith(b"\n"):
                return
            told = SUM.search(line)
            total = zlib.crc32(line[: told.start()] if told else line, position.sum)
            position = Position(position.n_lines + 1, position.end + len(line), total)
            if told and int(told[1], 16) != total:
                raise self._damaged(position.n_lines)
            yield line, position

    def _check_references(self, operation: dict[str, Any], number: int) -> None:
        """Raise `StudyError` if an operation refers to a study or a trial that no line before it created."""
        # Upper bounds: some lines create nothing, because two workers wrote them at once.
        self._n_studies += operation["op_code"] == JournalOperation.CREATE_STUDY
        is_known = operation.get("study_id", -1) < self._n_studies and operation.get("trial_id", -1) < self._n_trials
        self._n_trials += operation["op_code"] == JournalOperation.CREATE_TRIAL
        if not is_known:
            raise self._damaged(number)

    def _damaged(self, number: int) -> StudyError:
        return StudyError(
            f"{self._path.name} is damaged: lines at or before line {number} were lost or changed; put back a copy of "
            "the whole file, or name another one"
        )

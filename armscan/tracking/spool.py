"""What is to be tracked of a run, in a file of its folder: written there first, delivered to the store from there.

A line is an entry: figures, parameters, tags, a file to be kept, or the run's status. The file stays when all of it is
delivered; how far that is stands beside it. So whatever happens to the store, or to the process, nothing is lost, and
an entry that is delivered again, because only the answer was lost, changes nothing in the store.
"""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Self

from filelock import FileLock, Timeout

from armscan.errors import FolderInUseError, TrackingError
from armscan.files import SPOOL_SUFFIXES, SPOOLS, write_whole

Entry = dict[str, Any]
# Two, delivered side by side: where no file can be kept, because a disk is full, figures still are.
Lane = Literal["figures", "files"]
LANES: tuple[Lane, ...] = ("files", "figures")
DELIVERED, LOCK, SUFFIX = SPOOL_SUFFIXES
# Whoever hands a run over may still be leaving.
LOCK_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class Address:
    """Where the entries of a spool belong.

    Args:
        run_id: the run.
        uri: of its store, without a password.
    """

    run_id: str
    uri: str


class SpoolFile:
    """The entries of one run as they stand in its file, which whoever looks does not change.

    Args:
        file: with an `Address` in its first line.

    Raises:
        TrackingError: if the file is damaged.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._delivered_file = file.with_suffix(DELIVERED)
        try:
            self.address = Address(**next(self.entries())["address"])
        except (StopIteration, TypeError, KeyError) as error:
            raise TrackingError(f"{file}: does not begin with the run that it is of") from error
        self._delivered: dict[Lane, int] = dict.fromkeys(LANES, 0) | self._read_delivered()

    @property
    def folder(self) -> Path:
        """Of the run, that the names of its files are relative to."""
        return self.file.parent.parent

    def entries(self) -> Iterator[Entry]:
        """All entries, delivered or not.

        Raises:
            TrackingError: if a line is damaged.
        """
        with self.file.open("rb") as lines:
            for line in lines:
                yield self._read(line)

    def next_entries(self, lane: Lane, at_most: int) -> tuple[list[Entry], int]:
        """Returns the entries that are to be delivered next.

        Args:
            lane: of which.
            at_most: so many.

        Returns:
            The entries, and how far the file is delivered with them, for `mark`.
        """
        entries: list[Entry] = []
        end = self._delivered[lane]
        with self.file.open("rb") as lines:
            lines.seek(end)
            while len(entries) < at_most and (line := lines.readline()).endswith(b"\n"):
                end = lines.tell()
                entry = self._read(line)
                if ("file" in entry) == (lane == "files"):
                    entries.append(entry)
        return entries, end

    @property
    def is_delivered(self) -> bool:
        """Whether there is nothing to be delivered."""
        return all(not self.next_entries(lane, 1)[0] for lane in LANES)

    @property
    def status(self) -> str | None:
        """What the run was last said to be, None where nothing was said yet."""
        said = [entry["status"][0] for entry in self.entries() if "status" in entry]
        return said[-1] if said else None

    def _read(self, line: bytes) -> Entry:
        try:
            entry = json.loads(line)
        except ValueError as error:
            raise TrackingError(f"{self.file}: a line of it is damaged: {line[:50]!r}") from error
        if not isinstance(entry, dict):
            raise TrackingError(f"{self.file}: a line of it is damaged: {line[:50]!r}")
        return entry

    def _read_delivered(self) -> dict[Lane, int]:
        """Returns how far each lane is delivered; what cannot be is delivered once more, which changes nothing."""
        try:
            said = json.loads(self._delivered_file.read_bytes())
        except (FileNotFoundError, ValueError):
            said = None
        ends = said if isinstance(said, dict) else {}
        return {lane: ends[lane] for lane in LANES if self._is_end_of_a_line(ends.get(lane))}

    def _is_end_of_a_line(self, end: Any) -> bool:
        if type(end) is not int or not 0 < end <= self.file.stat().st_size:
            return False
        with self.file.open("rb") as lines:
            lines.seek(end - 1)
            return lines.read(1) == b"\n"


class Spool(SpoolFile):
    """The entries of one run, held by one process.

    Args:
        file: with an `Address` in its first line.
        timeout_s: how long another process is waited for that holds it.

    Raises:
        TrackingError: if the file is damaged.
        FolderInUseError: if another process holds it.
        FileNotFoundError: if there is no such file; nothing is made in its place.
    """

    def __init__(self, file: Path, *, timeout_s: float = LOCK_TIMEOUT_S) -> None:
        # The lock would make the folder of a run again that was removed.
        if not file.exists():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(file))
        # Also who is told to leave closes it, in another thread.
        self._lock = FileLock(file.with_suffix(LOCK), timeout=timeout_s, thread_local=False)
        try:
            self._lock.acquire()
        except Timeout as error:
            raise FolderInUseError(f"{file}: another process tracks this run") from error
        try:
            _cut_torn_line(file)
            super().__init__(file)
            self._appending, self._adding = file.open("ab", buffering=0), threading.Lock()
        except BaseException:
            self._lock.release()
            raise

    @classmethod
    def begin(cls, folder: Path, address: Address) -> Self:
        """Opens the spool of a run in a folder, and makes it where there is none."""
        file = file_of(folder, address.run_id)
        file.parent.mkdir(parents=True, exist_ok=True)
        if not file.exists():
            first = json.dumps({"address": asdict(address)}).encode() + b"\n"
            write_whole(file, lambda opened: opened.write(first))
        return cls(file)

    def add(self, **entry: Any) -> None:
        """Adds an entry; from then on neither the end of this process nor that of the store loses it."""
        line = json.dumps(entry).encode() + b"\n"
        with self._adding:
            size = os.fstat(self._appending.fileno()).st_size
            if self._appending.write(line) != len(line):
                # A full disk; half a line would be in the way of the next.
                os.truncate(self._appending.fileno(), size)
                raise OSError(f"{self.file}: cannot be written to: no space is left")

    def mark(self, lane: Lane, end: int) -> None:
        """Notes that a lane is delivered so far."""
        self._delivered[lane] = end
        text = json.dumps(self._delivered)
        write_whole(self._delivered_file, lambda opened: opened.write(text.encode()))

    def close(self) -> None:
        """Lets others hold it."""
        self._appending.close()
        self._lock.release()


def now_ms() -> int:
    """Returns the time as MLflow has it."""
    return time.time_ns() // 1_000_000


def file_of(folder: Path, run_id: str) -> Path:
    """Returns the file of a run's spool, whether it exists or not."""
    return folder / SPOOLS / f"{run_id}{SUFFIX}"


def spool_files(folder: Path) -> list[Path]:
    """Returns the files of all spools in a folder and the folders in it."""
    return sorted(folder.rglob(f"{SPOOLS}/*{SUFFIX}"))


def take_over(run_id: str, before: Path, folder: Path) -> None:
    """Takes the spool of a run to another folder, where the run is gone on with; nothing where there is none."""
    old, new = file_of(before, run_id), file_of(folder, run_id)
    if old.exists():
        new.parent.mkdir(parents=True, exist_ok=True)
        # What is not noted as delivered is delivered again, which changes nothing; so the order matters little.
        if old.with_suffix(DELIVERED).exists():
            old.with_suffix(DELIVERED).replace(new.with_suffix(DELIVERED))
        old.replace(new)


def _cut_torn_line(file: Path) -> None:
    """Removes the beginning of a line whose writer died, with the machine, in the middle of it."""
    with file.open("rb+") as opened:
        contents = opened.read()
        if contents and not contents.endswith(b"\n"):
            opened.truncate(contents.rfind(b"\n") + 1)

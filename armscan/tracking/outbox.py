"""The outbox of a run: a file in its folder that buffers everything to upload to the tracking store.

Each line is an entry: metrics, parameters, tags, a file to upload, or the run's status. A second file records how far
the entries are uploaded, so nothing is lost when the store is unavailable or the process is killed. Uploading an entry
twice, because only the reply was lost, changes nothing in the store.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Self

from filelock import FileLock, Timeout

from armscan.errors import FolderInUseError, TrackingError
from armscan.tracking.pending_runs import PENDING_FOLDER, PendingRun, forget
from armscan.utils.files import atomic_write, cache_folder, named_if_full, truncate_torn_line
from armscan.utils.processes import ProcessInfo
from armscan.utils.run_files import OUTBOX_FOLDER, OUTBOX_SUFFIXES

Entry = dict[str, Any]
# Uploaded independently: metrics arrive even if the disk of the artifacts is full.
Channel = Literal["figures", "files"]
CHANNELS: tuple[Channel, ...] = ("files", "figures")
UPLOADED, LOCK, SUFFIX = OUTBOX_SUFFIXES
ID = re.compile(r"[\w-]{1,64}", re.ASCII)
# Statuses of a run that has ended.
ENDED = ("FINISHED", "FAILED", "KILLED")
# The run's previous process may still be shutting down.
LOCK_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class Address:
    """Destination of an outbox: the ID of a run, and the address of its tracking store.

    Raises:
        TrackingError: If the ID is invalid; files are named after it.
    """

    run_id: str
    uri: str

    def __post_init__(self) -> None:
        if not isinstance(self.run_id, str) or not ID.fullmatch(self.run_id):
            raise TrackingError(f"{str(self.run_id)[:50]!r} is not the ID of a run")


class OutboxFile:
    """An outbox, read only.

    Args:
        file: File with an `Address` in its first line.

    Raises:
        TrackingError: If the file is damaged.
    """

    def __init__(self, file: Path) -> None:
        # A pipe or a device would be read for ever.
        if file.exists() and not file.is_file():
            raise TrackingError(f"{file}: is not a file")
        self.file = file
        self._uploaded_file = file.with_suffix(UPLOADED)
        try:
            self.address = Address(**next(self.entries())["address"])
        except (StopIteration, TypeError, KeyError) as error:
            raise TrackingError(f"{file}: does not begin with the ID of its run") from error
        # An untrusted folder could name a run of the user's.
        if self.address.run_id != file.stem:
            raise TrackingError(f"{file}: begins with the ID of another run, {self.address.run_id}")
        self._uploaded: dict[Channel, int] = dict.fromkeys(CHANNELS, 0) | self._read_uploaded()

    @property
    def folder(self) -> Path:
        """The run's folder, to which the names of files are relative."""
        return self.file.parent.parent

    def entries(self) -> Iterator[Entry]:
        """Iterate over all entries, uploaded or not."""
        with self.file.open("rb") as lines:
            for line in lines:
                yield self._read(line)

    def next_entries(self, channel: Channel, at_most: int) -> tuple[list[Entry], int]:
        """Return up to `at_most` entries of a channel, the next ones to upload.

        Returns:
            The entries, and the position behind them, for `mark`.
        """
        entries: list[Entry] = []
        end = self._uploaded[channel]
        with self.file.open("rb") as lines:
            lines.seek(end)
            while len(entries) < at_most and (line := lines.readline()).endswith(b"\n"):
                end = lines.tell()
                entry = self._read(line)
                if ("file" in entry) == (channel == "files"):
                    entries.append(entry)
        if not entries:
            # Do not read the other channel's entries again next time.
            self._uploaded[channel] = end
        return entries, end

    @property
    def is_removed(self) -> bool:
        """Whether the file was removed, with the run's folder or alone."""
        return not self.file.exists()

    @property
    def is_uploaded(self) -> bool:
        """Whether everything is uploaded."""
        return all(not self.next_entries(channel, 1)[0] for channel in CHANNELS)

    @property
    def n_uploaded_bytes(self) -> int:
        """How far the channels are uploaded, in bytes of the file, summed."""
        return sum(self._uploaded.values())

    @property
    def status(self) -> str | None:
        """The last status of the run; None if there is none yet."""
        return self._last_status[0]

    @property
    def status_ms(self) -> int:
        """When the run got its last status, in milliseconds since 1970; 0 if it has none yet."""
        return self._last_status[1]

    @property
    def _last_status(self) -> tuple[str | None, int]:
        last: tuple[str | None, int] = (None, 0)
        for entry in self.entries():
            last = entry.get("status", last)
        return last

    def _read(self, line: bytes) -> Entry:
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            entry = None
        if isinstance(entry, dict):
            match entry.get("status", ["", 0]):
                case [str(), int()]:
                    return entry
        raise TrackingError(f"{self.file}: a line is damaged: {line[:50]!r}")

    def _read_uploaded(self) -> dict[Channel, int]:
        """Return how far each channel is uploaded; ignore an invalid position, as uploading twice does no harm."""
        try:
            ends = dict(json.loads(self._uploaded_file.read_bytes()))
        except (FileNotFoundError, ValueError, TypeError):
            return {}
        return {channel: ends[channel] for channel in CHANNELS if self._is_end_of_a_line(ends.get(channel))}

    def _is_end_of_a_line(self, end: Any) -> bool:
        if type(end) is not int or not 0 < end <= self.file.stat().st_size:
            return False
        with self.file.open("rb") as lines:
            lines.seek(end - 1)
            return lines.read(1) == b"\n"


class Outbox(OutboxFile):
    """An outbox, locked by this process.

    Args:
        file: File with an `Address` in its first line.
        timeout_s: Seconds to wait for another process that has locked the file. Default: 20.

    Raises:
        TrackingError: If the file is damaged.
        FolderInUseError: If another process holds it.
        FileNotFoundError: If there is no such file; it is not created.
    """

    def __init__(self, file: Path, *, timeout_s: float = LOCK_TIMEOUT_S) -> None:
        # Acquiring the lock would recreate the folder of a removed run.
        file.stat()
        # Links in an untrusted folder may lead to any file of this user, which this process would write to.
        links = [each for each in (file.parent, *map(file.with_suffix, OUTBOX_SUFFIXES)) if each.is_symlink()]
        if links:
            raise TrackingError(f"{links[0]}: is a link, but outboxes are files of the run's own folder")
        # A process that is asked to stop releases it from another thread.
        self._lock = FileLock(file.with_suffix(LOCK), timeout=timeout_s, thread_local=False)
        try:
            self._lock.acquire()
        except Timeout as error:
            raise FolderInUseError(f"{file}: another process tracks this run") from error
        try:
            # First, so that no file is truncated that is not an outbox.
            super().__init__(file)
            truncate_torn_line(file)
            self._appending, self._adding = file.open("ab", buffering=0), threading.Lock()
            # Files that this process has added.
            self.added: set[str] = set()
        except BaseException:
            self._lock.release()
            raise

    @classmethod
    def begin(cls, folder: Path, address: Address) -> Self:
        """Open the outbox of a run in a folder; create it if there is none."""
        file = file_of(folder, address.run_id)
        file.parent.mkdir(parents=True, exist_ok=True)
        if not file.exists():
            atomic_write(file, json.dumps({"address": asdict(address)}) + "\n")
        return cls(file)

    def add(self, **entry: Any) -> None:
        """Append an entry. It survives this process and failures of the store."""
        line = json.dumps(entry).encode() + b"\n"
        if "file" in entry:
            self.added.add(file_and_place(entry["file"])[0])
        with self._adding:
            size = os.fstat(self._appending.fileno()).st_size
            with named_if_full(self.file):
                n_written = self._appending.write(line)
            if n_written != len(line):
                # The disk is full: remove the partial line, which would corrupt the next one.
                os.truncate(self._appending.fileno(), size)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.file))

    def mark(self, channel: Channel, end: int) -> None:
        """Record how far a channel is uploaded."""
        self._uploaded[channel] = end
        atomic_write(self._uploaded_file, json.dumps(self._uploaded))

    def mark_pending(self, uri: str) -> None:
        """Add the run to this machine's pending runs, so that the next start uploads what is left.

        Args:
            uri: Address of the store that this process opened; an untrusted outbox may name another.
        """
        # Nothing is lost without the record: `armscan runs sync` finds the outbox.
        with contextlib.suppress(OSError):
            folder = cache_folder() / PENDING_FOLDER
            folder.mkdir(parents=True, exist_ok=True)
            forget(self.address.run_id)
            PendingRun(self.file.absolute(), uri, ProcessInfo.current()).write(folder / self.address.run_id)

    def close(self) -> None:
        """Close and unlock the outbox."""
        self._appending.close()
        self._lock.release()


def now_ms() -> int:
    """Return the current time in MLflow's unit, milliseconds since 1970."""
    return time.time_ns() // 1_000_000


def file_of(folder: Path, run_id: str) -> Path:
    """Return the path of a run's outbox, which may not exist."""
    run_id = Address(run_id, "").run_id
    return folder / OUTBOX_FOLDER / f"{run_id}{SUFFIX}"


def file_and_place(value: str | list[str]) -> tuple[str, str | None]:
    """Return a file to upload, relative to the run's folder, and its artifact folder; None for the artifact root."""
    return (value, None) if isinstance(value, str) else (value[0], value[1])


def outbox_files(folder: Path) -> list[Path]:
    """Return the paths of all outboxes in a folder, recursively."""
    return sorted(folder.rglob(f"{OUTBOX_FOLDER}/*{SUFFIX}"))


def take_over(run_id: str, before: Path, folder: Path) -> None:
    """Move the outbox of a run, if there is one, to the folder in which the run is resumed.

    Args:
        run_id: MLflow run ID.
        before: Folder in which the run was tracked before.
        folder: Folder in which it is resumed.
    """
    old, new = file_of(before, run_id), file_of(folder, run_id)
    if old.exists():
        new.parent.mkdir(parents=True, exist_ok=True)
        # The order matters little: entries not recorded as uploaded are uploaded again, which changes nothing.
        if old.with_suffix(UPLOADED).exists():
            old.with_suffix(UPLOADED).replace(new.with_suffix(UPLOADED))
        old.replace(new)

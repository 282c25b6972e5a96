"""A run's local folder: verify ownership, list its files, keep other processes out."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout
from mlflow.entities import Run

from armscan.config.command_hints import armscan_command
from armscan.errors import ArmscanError, TrackingError
from armscan.tracking.outbox import LOCK, SUFFIX, UPLOADED, OutboxFile, file_and_place, file_of
from armscan.tracking.tags import FOLDER_TAG, HOST_TAG
from armscan.utils.files import UNFINISHED, sha256
from armscan.utils.run_files import (
    CONFIG_FILE,
    LOCK_FILE,
    OUTBOX_FOLDER,
    POLICY_FOLDER,
    RECORDS,
    RESULTS,
    SHA256_TAGS,
    STARTED_WITH,
    is_made_by_run,
)

HYDRA_FOLDER = ".hydra"
HYDRA_FILES = tuple(f"{HYDRA_FOLDER}/{name}.yaml" for name in ("config", "hydra", "overrides"))


class RunSkippedError(ArmscanError):
    """The files of a run must be left as they are; the message says why."""


@dataclass(frozen=True)
class OwnFolder:
    """A folder of this machine that verifiably is a run's."""

    path: Path
    run_id: str

    @classmethod
    def of(cls, run: Run) -> OwnFolder:
        """Return the folder of a run.

        Raises:
            RunSkippedError: If there is none on this machine, or it is not certain that it is the run's.
        """
        path = _noted(run)
        config = path / CONFIG_FILE
        if path.resolve() != path:
            raise RunSkippedError(f"its folder {path} is reached through a link")
        if not path.is_dir():
            raise RunSkippedError(f"its folder {path} is gone")
        if config.is_symlink() or not config.is_file():
            raise RunSkippedError(f"{path} has no {CONFIG_FILE}, so it may not be the run's")
        try:
            contents = config.read_bytes()
        except OSError as error:
            raise RunSkippedError(f"{config} cannot be read ({error.strerror})") from error
        if sha256(contents) != run.data.tags.get(SHA256_TAGS[CONFIG_FILE]):
            raise RunSkippedError(f"{path} holds another {CONFIG_FILE} than the run was started with")
        outboxes = (path / OUTBOX_FOLDER).glob(f"*{SUFFIX}")
        if others := [file.stem for file in outboxes if file.stem != run.info.run_id]:
            raise RunSkippedError(f"{path} is the folder of run {others[0]}, too")
        return cls(path, run.info.run_id)

    def files(self) -> dict[Path, int]:
        """Return the run's own files with their sizes in bytes; last, those that prove ownership or lock the folder."""
        last = [CONFIG_FILE, *(f"{OUTBOX_FOLDER}/{self.run_id}{end}" for end in (UPLOADED, SUFFIX, LOCK)), LOCK_FILE]
        unfinished = [file.name for file in self.path.glob(f".*.{UNFINISHED}")]
        names = [*unfinished, *RESULTS, *STARTED_WITH, *RECORDS, *self._tracked(), *HYDRA_FILES]
        found = {}
        for name in (*dict.fromkeys(name for name in names if name not in last), *last):
            file = self.path / name
            with contextlib.suppress(OSError):
                status = file.lstat()
                # No links, which may lead out of the folder.
                if stat.S_ISREG(status.st_mode) and file.parent.resolve().is_relative_to(self.path):
                    found[file] = status.st_size
        return found

    def _tracked(self) -> Iterator[str]:
        """Yield the names of the files that the run has tracked; earlier versions tracked all files of the folder."""
        with contextlib.suppress(OSError, TrackingError):
            for entry in OutboxFile(file_of(self.path, self.run_id)).entries():
                if "file" in entry and is_made_by_run(name := file_and_place(entry["file"])[0]):
                    yield name

    @contextlib.contextmanager
    def held(self, *, is_planned: bool = False) -> Iterator[None]:
        """Return a context in which no other process works in the folder or uploads from it.

        Args:
            is_planned: Whether the removal is only planned; a folder without lock files is not locked then. Default:
                False.

        Raises:
            RunSkippedError: If another process is using it, or something is not uploaded yet.
        """
        outbox = file_of(self.path, self.run_id)
        with contextlib.ExitStack() as stack:
            try:
                for lock in (self.path / LOCK_FILE, outbox.with_suffix(LOCK)):
                    if lock.exists() or (lock.parent.is_dir() and not is_planned):
                        stack.enter_context(FileLock(lock, timeout=0))
                is_uploaded = not outbox.exists() or OutboxFile(outbox).is_uploaded
            except Timeout as error:
                raise RunSkippedError(f"another process is using its folder {self.path}") from error
            except TrackingError as error:
                raise RunSkippedError(f"the outbox in its folder cannot be read: {error}") from error
            except OSError as error:
                raise RunSkippedError(
                    f"it is unknown whether another process is using its folder {self.path} ({error.strerror})"
                ) from error
            if not is_uploaded:
                raise RunSkippedError(
                    f"not all of it is uploaded: run {armscan_command('runs', 'sync', str(self.path))}"
                )
            yield

    def remove_emptied(self) -> bool:
        """Remove the folder if it is empty; return whether it is gone."""
        model = self.path / POLICY_FOLDER
        inner = [] if model.is_symlink() else [Path(where) for where, _, _ in os.walk(model, topdown=False)]
        for folder in (*inner, self.path / HYDRA_FOLDER, self.path / OUTBOX_FOLDER, self.path):
            # It may contain other files, or be the working folder.
            with contextlib.suppress(OSError):
                if not Path.cwd().is_relative_to(folder):
                    folder.rmdir()
        return not self.path.exists()


def _noted(run: Run) -> Path:
    """Return the folder on this machine that was noted for a run."""
    folder, host = run.data.tags.get(FOLDER_TAG), run.data.tags.get(HOST_TAG)
    if folder is None:
        raise RunSkippedError("no folder was noted for it")
    if host is None:
        raise RunSkippedError(f"its folder {folder} was noted without its host")
    if host != socket.gethostname():
        raise RunSkippedError(f"its folder {folder} is on the host {host}")
    if not Path(folder).is_absolute():
        raise RunSkippedError(f"its folder is {folder!r}, which is not an absolute path")
    return Path(folder)

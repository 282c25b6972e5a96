"""A run's local folder: verify ownership, list its files, check that no process uses it."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout
from mlflow.entities import Run

from armscan.config.command_hints import sync_command
from armscan.errors import ArmscanError, FolderInUseError, TrackingError
from armscan.tracking.outbox import DELIVERED, LOCK, SUFFIX, Outbox, OutboxFile, file_of
from armscan.utils.files import (
    BEST_CHECKPOINT,
    CONFIG_FILE,
    LAST_CHECKPOINT,
    LOCK_FILE,
    OUTBOX_FOLDER,
    POLICY_FOLDER,
    RECORDS,
    RESULTS,
    SHA256_TAGS,
    STARTED_WITH,
    UNFINISHED,
    folder_lock,
    is_made_by_run,
    sha256,
)

CHECKPOINTS = (LAST_CHECKPOINT, BEST_CHECKPOINT)
# The outbox names what a run has kept beside these.
USUAL = (*RESULTS, *STARTED_WITH, *RECORDS)
HYDRA_FOLDER = ".hydra"
HYDRA_FILES = tuple(f"{HYDRA_FOLDER}/{name}.yaml" for name in ("config", "hydra", "overrides"))


class FolderNotOwnedError(ArmscanError):
    """There is no folder on this machine that verifiably is the run's; the message says why.

    Args:
        message: of one line.
        is_there: whether there is a folder that stays, because nobody knows that it is the run's.
    """

    def __init__(self, message: str, *, is_there: bool = True) -> None:
        super().__init__(message)
        self.is_there = is_there


class RunSkippedError(ArmscanError):
    """A run must be left as it is; the message says why."""


@dataclass(frozen=True)
class OwnFolder:
    """A folder that verifiably is a run's.

    Args:
        path: of the folder.
        run_id: of the run.
    """

    path: Path
    run_id: str

    @classmethod
    def of(cls, run: Run, *, sharing: str | None = None) -> OwnFolder:
        """Return the folder of a run.

        Args:
            run: the run.
            sharing: ID of another run with the same folder, where the store knows of one.

        Raises:
            NotOursError: if there is none, or it is not certain that it is the run's.
        """
        tags, run_id = run.data.tags, run.info.run_id
        path = _noted(tags)
        if path.resolve() != path:
            raise FolderNotOwnedError(f"its folder {path} is reached through a link")
        if not path.is_dir():
            raise FolderNotOwnedError(f"its folder {path} is not there any more", is_there=False)
        config = path / CONFIG_FILE
        if config.is_symlink() or not config.is_file():
            raise FolderNotOwnedError(f"{path} has no {CONFIG_FILE}, so that nobody knows whether it is the run's")
        try:
            contents = config.read_bytes()
        except OSError as error:
            raise FolderNotOwnedError(f"{config} cannot be read ({error.strerror})") from error
        if sha256(contents) != tags.get(SHA256_TAGS[CONFIG_FILE]):
            raise FolderNotOwnedError(f"{path} holds another {CONFIG_FILE} than the run was started with")
        others = [file.stem for file in (path / OUTBOX_FOLDER).glob(f"*{SUFFIX}") if file.stem != run_id]
        if others or sharing is not None:
            raise FolderNotOwnedError(f"{path} is the folder of run {sharing or others[0]}, too")
        return cls(path, run_id)

    @property
    def files(self) -> tuple[Path, ...]:
        """The files in it that are the run's; last those by which they are known to be, or held."""
        names = [*USUAL, *_named_in(file_of(self.path, self.run_id)), *HYDRA_FILES]
        last = [CONFIG_FILE, *(f"{OUTBOX_FOLDER}/{self.run_id}{end}" for end in (DELIVERED, SUFFIX, LOCK)), LOCK_FILE]
        unfinished = [file.name for file in self.path.glob(f".*.{UNFINISHED}")]
        unique = dict.fromkeys(name for name in (*unfinished, *names) if name not in last)
        return tuple(self.path / name for name in (*unique, *last) if self._is_file(name))

    @property
    def checkpoints(self) -> tuple[Path, ...]:
        """Those of the files that are checkpoints."""
        return tuple(self.path / name for name in CHECKPOINTS if self._is_file(name))

    @property
    def n_bytes(self) -> int:
        """Of the files."""
        return bytes_of(self.files)

    def remove_emptied(self) -> bool:
        """Remove the folder where nothing is left in it; return whether it is gone."""
        model = self.path / POLICY_FOLDER
        inner = [] if model.is_symlink() else [Path(where) for where, _, _ in os.walk(model, topdown=False)]
        for folder in (*inner, self.path / HYDRA_FOLDER, self.path / OUTBOX_FOLDER, self.path):
            # Somebody's files are in it, or their own feet.
            with contextlib.suppress(OSError):
                if not Path.cwd().is_relative_to(folder):
                    folder.rmdir()
        return not self.path.exists()

    def _is_file(self, name: str) -> bool:
        """Whether a name is that of a file in the folder, and nothing that leads out of it."""
        file = self.path / name
        try:
            return stat.S_ISREG(file.lstat().st_mode) and file.parent.resolve().is_relative_to(self.path)
        except OSError:
            return False


def bytes_of(files: Iterable[Path]) -> int:
    """Return how much files take, as far as nobody has removed them meanwhile."""
    n_bytes = 0
    for file in files:
        with contextlib.suppress(FileNotFoundError):
            n_bytes += file.lstat().st_size
    return n_bytes


def check_at_rest(run: Run) -> None:
    """Look whether a run's folder may be touched, and touches nothing.

    Raises:
        RunSkippedError: if another process holds it, or something is not delivered.
    """
    if (folder := folder_here(run)) is None:
        return
    file = file_of(folder, run.info.run_id)
    try:
        is_held = any(_is_held(lock) for lock in (folder / LOCK_FILE, file.with_suffix(LOCK)))
    except OSError as error:
        raise RunSkippedError(_closed(folder, error)) from error
    if is_held:
        raise RunSkippedError(f"another process is at work in its folder {folder}")
    if file.exists():
        try:
            is_delivered = OutboxFile(file).is_delivered
        except (TrackingError, OSError) as error:
            raise RunSkippedError(f"what it was to be tracked with cannot be read: {error}") from error
        if not is_delivered:
            raise RunSkippedError(_undelivered(folder))


@contextlib.contextmanager
def at_rest(run: Run) -> Iterator[OwnFolder | None]:
    """Hold a run's folder and outbox, so that no process begins to work there; give the folder, None for none.

    Raises:
        RunSkippedError: as `check_at_rest`.
    """
    check_at_rest(run)
    try:
        ours = OwnFolder.of(run)
    except FolderNotOwnedError:
        # Somebody else's, where nothing may be left behind, not even a lock; nor can the run be gone on with there.
        yield None
        return
    file = file_of(ours.path, run.info.run_id)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(folder_lock(ours.path))
            _check_still_there(ours)
            outbox = stack.enter_context(contextlib.closing(Outbox(file, timeout_s=0.0))) if file.exists() else None
        except FolderInUseError as error:
            raise RunSkippedError(f"another process is at work in its folder {ours.path}") from error
        except OSError as error:
            raise RunSkippedError(_closed(ours.path, error)) from error
        if outbox is not None and not outbox.is_delivered:
            raise RunSkippedError(_undelivered(ours.path))
        yield ours


def _check_still_there(ours: OwnFolder) -> None:
    """Look into a folder that is held by now; its lock makes one again that was removed just before.

    Raises:
        RunSkippedError: if another process has removed it.
    """
    if not (ours.path / CONFIG_FILE).exists():
        with contextlib.suppress(OSError):
            (ours.path / LOCK_FILE).unlink()
            ours.path.rmdir()
        raise RunSkippedError("it is not there any more")


def folder_here(run: Run) -> Path | None:
    """Return the folder that was noted for a run, where one may be on this machine, whether it is the run's or not."""
    folder, host = Path(run.data.tags.get("folder", "")), run.data.tags.get("host")
    return folder if folder.is_absolute() and folder.is_dir() and host in (None, socket.gethostname()) else None


def _noted(tags: Mapping[str, str]) -> Path:
    if "folder" not in tags:
        raise FolderNotOwnedError("no folder was noted for it", is_there=False)
    if "host" not in tags:
        raise FolderNotOwnedError(f"its folder {tags['folder']} was noted without its host")
    if tags["host"] != socket.gethostname():
        raise FolderNotOwnedError(f"its folder {tags['folder']} is on the host {tags['host']}")
    path = Path(tags["folder"])
    if not path.is_absolute():
        raise FolderNotOwnedError(f"its folder is {str(path)!r}, and nobody knows where that is")
    return path


def _named_in(outbox: Path) -> list[str]:
    """Return the names of the files in an outbox, as far as runs make files of such names.

    Runs of earlier versions have kept whatever was in their folder.
    """
    names = []
    try:
        lines = outbox.read_bytes().splitlines()
    except OSError:
        return []
    for line in lines:
        # A damaged one names nothing.
        with contextlib.suppress(ValueError):
            entry = json.loads(line)
            kept = entry.get("file") if isinstance(entry, dict) else None
            # One of a folder that was kept as a whole stands with its place among the artifacts.
            name = kept[0] if isinstance(kept, list) and kept else kept
            if isinstance(name, str) and is_made_by_run(name):
                names.append(name)
    return names


def _is_held(lock: Path) -> bool:
    if not lock.exists():
        return False
    try:
        with FileLock(lock, timeout=0):
            return False
    except Timeout:
        return True


def _closed(folder: Path, error: OSError) -> str:
    return f"nobody knows whether another process is at work in its folder {folder} ({error.strerror})"


def _undelivered(folder: Path) -> str:
    return f"not all of it is delivered: {sync_command(folder)} does that"

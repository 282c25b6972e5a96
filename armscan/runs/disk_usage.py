"""What runs take of disks: in their folders on this machine, and in the store of their artifacts."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

from mlflow.entities import Run
from mlflow.exceptions import MlflowException
from requests import RequestException

from armscan.runs.run_folder import FolderNotOwnedError, OwnFolder, bytes_of
from armscan.tracking import TrackingStore


@dataclass(frozen=True)
class Size:
    """Bytes on disks.

    Args:
        in_folder: of the run's own files in its folder on this machine.
        in_store: of its artifacts; None where their store does not tell.
    """

    in_folder: int = 0
    in_store: int | None = 0

    @property
    def n_bytes(self) -> int:
        """All that is known."""
        return self.in_folder + (self.in_store or 0)

    def __add__(self, other: Size) -> Size:
        in_store = None if self.in_store is None or other.in_store is None else self.in_store + other.in_store
        return Size(self.in_folder + other.in_folder, in_store)


class Sizes:
    """Measures runs, each once.

    Args:
        client: of the store.
    """

    def __init__(self, client: TrackingStore) -> None:
        self._client = client
        self._known: dict[str, Size] = {}

    def of(self, run: Run) -> Size:
        """Return what a run takes."""
        run_id = run.info.run_id
        if run_id not in self._known:
            files = self.artifacts(run)
            in_store = None if files is None else sum(files.values())
            self._known[run_id] = Size(self._in_folder(run), in_store)
        return self._known[run_id]

    def artifacts(self, run: Run) -> dict[str, int] | None:
        """Return the bytes of each artifact by its path; None where their store does not tell."""
        if (folder := local_artifacts(run)) is not None:
            return dict(sorted(_files_in(folder)))
        try:
            return dict(self._listed(run.info.run_id, None))
        # What is there is not lost because nobody can say how much it is.
        except (MlflowException, RequestException, OSError):
            return None

    def _listed(self, run_id: str, path: str | None) -> list[tuple[str, int]]:
        files: list[tuple[str, int]] = []
        for each in self._client.list_artifacts(run_id, path):
            files += self._listed(run_id, each.path) if each.is_dir else [(each.path, each.file_size or 0)]
        return files

    @staticmethod
    def _in_folder(run: Run) -> int:
        try:
            return OwnFolder.of(run).n_bytes
        except FolderNotOwnedError:
            return 0


def local_artifacts(run: Run) -> Path | None:
    """Return the folder of a run's artifacts where these are files; None where a server or another store has them."""
    parts = urlsplit(run.info.artifact_uri)
    return Path(unquote(parts.path)) if parts.scheme in ("", "file") else None


def _files_in(folder: Path) -> list[tuple[str, int]]:
    """Return the files in a folder and in the folders in it, with their bytes; what links lead to is not followed."""
    found = []
    for where, _, names in os.walk(folder):
        for name in names:
            file = Path(where, name)
            if not file.is_symlink():
                found.append((file.relative_to(folder).as_posix(), bytes_of([file])))
    return found

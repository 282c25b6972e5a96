"""Removal of what a run that failed before it was tracked left in its folder."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from armscan.errors import FolderInUseError, FolderTakenError
from armscan.experiment.job import OUTCOME_FOLDER, PARENT_FILE
from armscan.utils.files import CONFIG_FILE, LOCK_FILE, OUTBOX_FOLDER, OUTBOX_SUFFIXES, RUN_ID


def remove_if_untracked(folder: Path, error: BaseException) -> None:
    """Remove what a run has left that failed before it was tracked; from then on it can be resumed."""
    is_tracked = (folder / CONFIG_FILE).exists() and not isinstance(error, FolderTakenError)
    # Where somebody else is at work in the folder, everything is theirs.
    if not is_tracked and not isinstance(error, FolderInUseError):
        remove_run_folder(folder)


def remove_run_folder(folder: Path) -> None:
    """Remove what a run that came to nothing has left in its folder, and the folders that are empty then.

    Nothing else is touched: the folder may be one that somebody named, with other files in it.
    """
    for ours in (folder / ".hydra", folder / OUTCOME_FOLDER):
        shutil.rmtree(ours, ignore_errors=True)
    for ours in (folder / PARENT_FILE, folder / "multirun.yaml", folder / LOCK_FILE):
        ours.unlink(missing_ok=True)
    for ours in (file for suffix in OUTBOX_SUFFIXES for file in (folder / OUTBOX_FOLDER).glob(RUN_ID + suffix)):
        ours.unlink(missing_ok=True)
    # Somebody else's is not empty.
    with contextlib.suppress(OSError):
        (folder / OUTBOX_FOLDER).rmdir()
    here = Path.cwd()
    for emptied in (folder, folder.parent, folder.parent.parent):
        if here.is_relative_to(emptied.resolve()) or not emptied.is_dir() or any(emptied.iterdir()):
            break
        emptied.rmdir()

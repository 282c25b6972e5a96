"""Remove the checkpoints or folders of ended runs: first planned, then run by run, each checked once more."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mlflow.entities import Run
from rich.filesize import decimal

from armscan.errors import TrackingError
from armscan.runs.query import experiment_ids
from armscan.runs.run_folder import OwnFolder, RunSkippedError
from armscan.tracking import TrackingStore, check_version
from armscan.tracking.outbox import ENDED
from armscan.tracking.pending_runs import forget
from armscan.tracking.tags import AGENT_TAG, FOLDER_TAG, PARENT_TAG, TRIAL_TAG
from armscan.tracking.tracking_store import reason_in
from armscan.utils.run_files import BEST_CHECKPOINT, LAST_CHECKPOINT

CHECKPOINTS, FOLDERS = "checkpoints", "folders"


@dataclass(frozen=True)
class PruneItem:
    """Files of a run that are to be removed, or the reason why they stay.

    Args:
        run: Run whose files would be removed.
        n_bytes: Disk space that their removal frees, in bytes.
        left: Reason why they stay; None if they are to be removed.
    """

    run: Run
    n_bytes: int = 0
    left: str | None = None


def plan(store: TrackingStore, runs: Sequence[Run], what: str) -> list[PruneItem]:
    """Plan the removal of files of runs; remove nothing.

    Args:
        store: Tracking store of the runs.
        runs: Runs whose files are to be removed.
        what: `CHECKPOINTS`, or `FOLDERS` for all files of a run.

    Returns:
        The plan of each run: the bytes that it would free, or the reason why its files stay.
    """
    everything = {run.info.run_id: run for run in store.runs(experiment_ids(store))}
    noted = defaultdict(set)
    for run_id, run in everything.items():
        noted[run.data.tags.get(FOLDER_TAG)].add(run_id)
    items = []
    for run in runs:
        # The run of a trial has no files: its seeds have.
        if TRIAL_TAG in run.data.tags and AGENT_TAG not in run.data.tags:
            continue
        try:
            folder = _folder(run, everything, noted[run.data.tags.get(FOLDER_TAG)] - {run.info.run_id})
            with folder.held(is_planned=True):
                items.append(PruneItem(run, sum(_files(folder, what).values())))
        except (RunSkippedError, TrackingError) as error:
            items.append(PruneItem(run, left=str(error)))
    return items


def remove(store: TrackingStore, item: PruneItem, what: str) -> str | None:
    """Remove the files of a run that a plan names.

    Args:
        store: Tracking store of the run.
        item: Plan of the run; one that says why its files stay is not allowed.
        what: `CHECKPOINTS` or `FOLDERS`, as in the plan.

    Returns:
        Reason why the folder is still there; None if it is gone, or only checkpoints were to be removed.

    Raises:
        RunSkippedError: If the files must now be kept; nothing has been removed.
        OSError: If a file cannot be removed.
    """
    run_id = item.run.info.run_id
    folder = OwnFolder.of(item.run)
    with folder.held():
        # Another process may have begun to use it, or have removed it, since it was planned.
        now = _with_ancestors(store, run_id)
        if run_id not in now:
            raise RunSkippedError("it has been deleted meanwhile")
        for file in _files(_folder(now[run_id], now), what):
            file.unlink(missing_ok=True)
        if what == CHECKPOINTS:
            return None
        forget(run_id)
        return None if folder.remove_emptied() else f"{folder.path} stays, with what is not the run's"


def remove_planned(store: TrackingStore, items: Sequence[PruneItem], what: str) -> int:
    """Remove the planned files, run by run, and print each outcome; return the exit code."""
    freed, n_removed, n_failed = 0, 0, 0
    for item in items:
        run_id = item.run.info.run_id
        if item.left is not None:
            print(f"{run_id} stays: {item.left}")
            continue
        try:
            note = remove(store, item, what)
        except RunSkippedError as error:
            print(f"{run_id} stays: {error}")
        # A failure for one run must not stop the others.
        except Exception as error:
            n_failed += 1
            reason = f"{error.filename}: {error.strerror}" if isinstance(error, PermissionError) else reason_in(error)
            print(f"{run_id} is not removed: {reason}", file=sys.stderr)
        else:
            freed, n_removed = freed + item.n_bytes, n_removed + 1
            print(f"{run_id} removed, {decimal(item.n_bytes)}" + (f"; {note}" if note else ""), flush=True)
    print(f"{what} of {n_removed} of {len(items)} runs removed, {decimal(freed)}")
    return 1 if n_failed else 0


def _folder(run: Run, runs: Mapping[str, Run], sharing: Collection[str] = ()) -> OwnFolder:
    """Return the folder of a run alone; raise if others share it, or if it, or one above it in `runs`, may continue."""
    check_version(run)
    if run.info.status not in ENDED:
        raise RunSkippedError(f"it is {run.info.status}, and could be resumed from there")
    # Above a seed's run are its trial and the study, which may resume it, or copy its checkpoints to other trials.
    seen, above = {run.info.run_id}, runs.get(run.data.tags.get(PARENT_TAG, ""))
    while above is not None and above.info.run_id not in seen:
        if above.info.status not in ENDED:
            what = "parent" if len(seen) == 1 else "study"
            raise RunSkippedError(f"its {what}, run {above.info.run_id}, is {above.info.status}, and may resume it")
        seen.add(above.info.run_id)
        above = runs.get(above.data.tags.get(PARENT_TAG, ""))
    folder = OwnFolder.of(run)
    if sharing:
        raise RunSkippedError(f"{folder.path} is the folder of run {min(sharing)}, too")
    return folder


def _with_ancestors(store: TrackingStore, run_id: str) -> dict[str, Run]:
    """Return a run and those above it, as the store has them now, by their IDs; empty if it has been deleted."""
    everywhere, runs = experiment_ids(store), dict[str, Run]()
    while run_id.isalnum() and run_id not in runs:
        if not (found := store.runs(everywhere, f"attributes.run_id = '{run_id}'")):
            break
        (runs[run_id],) = found
        run_id = runs[run_id].data.tags.get(PARENT_TAG, "")
    return runs


def _files(folder: OwnFolder, what: str) -> dict[Path, int]:
    """Return the files to remove with their bytes; raise if there are none."""
    checkpoints = (folder.path / LAST_CHECKPOINT, folder.path / BEST_CHECKPOINT)
    files = {file: n for file, n in folder.files().items() if what == FOLDERS or file in checkpoints}
    if not files:
        raise RunSkippedError("its folder holds no checkpoint of it")
    return files

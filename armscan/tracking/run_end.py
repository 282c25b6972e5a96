"""Record the end of a run from a process other than its own, such as the launcher of its grid or study."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

from armscan.errors import FolderInUseError, TrackingError
from armscan.tracking.outbox import ENDED, Address, Outbox, now_ms, outbox_files
from armscan.tracking.run import SHORT_WAIT_S, TrackedRun
from armscan.tracking.sanitize import tags_of
from armscan.tracking.store import absolute
from armscan.tracking.tracking_store import TrackingStore


def fail_dead_runs(folder: Path, store: TrackingStore, reason: str) -> None:
    """Mark the runs of dead processes in a folder tree as FAILED.

    Entries that the store cannot take now stay in the folders of the runs.

    Args:
        folder: Folder of the runs, or above them.
        store: Store of the runs.
        reason: Reason of the failure, for the tag `failure`.
    """
    for file in outbox_files(folder):
        try:
            outbox = Outbox(file, timeout_s=0.0)
            is_ended = outbox.status in ENDED
        # Its process is alive, another has just taken it over, or it is damaged, which `sync` reports.
        except (FolderInUseError, FileNotFoundError, TrackingError):
            continue
        if is_ended:
            outbox.close()
        else:
            TrackedRun(store, outbox, name=outbox.address.run_id).end("FAILED", reason=reason, wait_s=SHORT_WAIT_S)


def begin_outbox(folder: Path, run_id: str, uri: str) -> Outbox:
    """Open the outbox of a run, which is then pending here: if this process dies, a later one closes the run."""
    outbox = Outbox.begin(folder, Address(run_id, absolute(uri)))
    outbox.mark_pending(absolute(uri))
    return outbox


def record_end(folder: Path, run_id: str, uri: str, status: str, tags: Mapping[str, str]) -> None:
    """Record a run's end in its outbox, for `sync` to upload, without contacting the store.

    Args:
        folder: Folder of the run.
        run_id: MLflow run ID.
        uri: Address of its tracking store.
        status: FINISHED, FAILED or KILLED.
        tags: Tags to set.
    """
    with contextlib.closing(begin_outbox(folder, run_id, uri)) as outbox:
        if tags:
            outbox.add(tags=tags_of(tags))
        outbox.add(status=(status, now_ms()))

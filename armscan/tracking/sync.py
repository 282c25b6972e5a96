"""Deliveries after the fact: what runs have left in their folders, because their store was away or they died."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from armscan.errors import FolderInUseError
from armscan.tracking.client import TrackingStore, reason_in
from armscan.tracking.courier import deliver
from armscan.tracking.run import SHORT_WAIT_S, TrackedRun
from armscan.tracking.spool import LANES, Spool, spool_files

# Of a run: how it ended, as its spool says it.
ENDED = ("FINISHED", "FAILED", "KILLED")
IN_USE = "it is still going on"


@dataclass(frozen=True)
class Delivery:
    """What became of the entries of a run.

    Args:
        folder: of the run.
        run_id: of the run; None where another process holds it.
        n_entries: that were delivered now.
        left: why some are not delivered; None where all are.
    """

    folder: Path
    run_id: str | None
    n_entries: int
    left: str | None


def sync(folder: Path, opened: Callable[[str], TrackingStore]) -> list[Delivery]:
    """Delivers what the runs in a folder, and in the folders in it, have left.

    Args:
        folder: of a run, of a study, or above them.
        opened: opens a store by its address.

    Returns:
        What became of each run that had something left.

    Raises:
        TrackingError: if what a run has left is damaged, or a store cannot be used.
    """
    deliveries = []
    for file in spool_files(folder):
        try:
            spool = Spool(file, timeout_s=0.0)
        except FolderInUseError:
            deliveries.append(Delivery(file.parent.parent, None, 0, IN_USE))
            continue
        try:
            if not spool.is_delivered:
                deliveries.append(_delivered(spool, opened(spool.address.uri)))
        finally:
            spool.close()
    return deliveries


def _delivered(spool: Spool, store: TrackingStore) -> Delivery:
    n_entries, left = 0, None
    for lane in LANES:
        try:
            n_entries += deliver(spool, store.mlflow, lane)
        # Whatever a store raises: what it does not take stays there, and the next lane may be taken.
        except Exception as error:
            left = reason_in(error)
    return Delivery(spool.folder, spool.address.run_id, n_entries, left)


def abandon(folder: Path, store: TrackingStore, reason: str) -> None:
    """Ends the runs as failed whose process has died, in a folder and in the folders in it.

    What the store does not get now is in their folders.

    Args:
        folder: of a trial.
        store: that they are in.
        reason: why they failed.
    """
    for file in spool_files(folder):
        try:
            spool = Spool(file, timeout_s=0.0)
        # Its process is alive, or another has just taken it over.
        except (FolderInUseError, FileNotFoundError):
            continue
        is_ended, run_id = spool.status in ENDED, spool.address.run_id
        spool.close()
        if not is_ended:
            run = TrackedRun.joined(store, run_id, name=run_id, folder=file.parent.parent)
            run.end("FAILED", reason=reason, wait_s=SHORT_WAIT_S)

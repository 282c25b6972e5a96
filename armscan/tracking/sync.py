"""Deliveries after the fact: what runs have left in their folders, because their store was away or they died."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from armscan.errors import FolderInUseError, TrackingError
from armscan.log import say
from armscan.tracking import leftovers
from armscan.tracking.client import TrackingStore, reason_in
from armscan.tracking.courier import deliver
from armscan.tracking.limits import tags_of
from armscan.tracking.run import SHORT_WAIT_S, TrackedRun
from armscan.tracking.spool import LANES, Address, Spool, now_ms, spool_files
from armscan.tracking.store import absolute

# Of a run: how it ended, as its spool says it.
ENDED = ("FINISHED", "FAILED", "KILLED")
IN_USE = "it is still going on"
# Stores whose leftovers this process has looked for.
_looked_for: set[str] = set()


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
    """
    deliveries: list[Delivery] = []
    stores: dict[str, TrackingStore | TrackingError] = {}
    for file in spool_files(folder):
        try:
            spool = Spool(file, timeout_s=0.0)
        except FileNotFoundError:
            # Its run was removed since.
            continue
        except (FolderInUseError, TrackingError) as error:
            left = IN_USE if isinstance(error, FolderInUseError) else str(error)
            deliveries.append(Delivery(file.parent.parent, None, 0, left))
            continue
        with contextlib.closing(spool):
            deliveries += _what_became_of(spool, opened, stores)
    return deliveries


def _what_became_of(
    spool: Spool, opened: Callable[[str], TrackingStore], stores: dict[str, TrackingStore | TrackingError]
) -> list[Delivery]:
    """Returns what became of a run's entries, nothing where none were left."""
    run_id, uri = spool.address.run_id, spool.address.uri
    try:
        if spool.is_delivered:
            return []
        if uri not in stores:
            try:
                stores[uri] = opened(uri)
            except TrackingError as error:
                # Not to be waited for again with the next run.
                stores[uri] = error
        if isinstance(store := stores[uri], TrackingError):
            raise store
    except TrackingError as error:
        return [Delivery(spool.folder, run_id, 0, str(error))]
    return [_delivered(spool, store)]


def _delivered(spool: Spool, store: TrackingStore) -> Delivery:
    n_entries, left = 0, None
    for lane in LANES:
        try:
            n_entries += deliver(spool, store.mlflow, lane, is_whole=False)
        # Whatever a store raises: what it does not take stays there, and the next lane may be taken.
        except Exception as error:
            left = reason_in(error)
    return Delivery(spool.folder, spool.address.run_id, n_entries, left)


def deliver_leftovers(store: TrackingStore) -> None:
    """Delivers what earlier runs of a store have left on this machine; in the background, and once in a process."""
    if store.uri not in _looked_for:
        _looked_for.add(store.uri)
        threading.Thread(target=_deliver_leftovers, args=(store,), name="leftovers", daemon=True).start()


def _deliver_leftovers(store: TrackingStore) -> None:
    for note, file in leftovers.noted():
        try:
            spool = Spool(file, timeout_s=0.0)
        except FolderInUseError:
            # Its run goes on, and delivers for itself.
            continue
        except (OSError, ValueError, TrackingError):
            # Removed with its folder, or damaged, the note or the spool, which `armscan.track sync` tells whoever asks.
            note.unlink(missing_ok=True)
            continue
        with contextlib.closing(spool):
            if spool.address.uri != store.uri:
                continue
            delivery = _delivered(spool, store)
            if delivery.left is None:
                note.unlink(missing_ok=True)
            if delivery.n_entries:
                say(f"run {delivery.run_id}: {delivery.n_entries} entries that it had left are delivered now")


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
            is_ended = spool.status in ENDED
        # Its process is alive, another has just taken it over, or it is damaged, which whoever delivers it is told.
        except (FolderInUseError, FileNotFoundError, TrackingError):
            continue
        if is_ended:
            spool.close()
        else:
            TrackedRun(store, spool, name=spool.address.run_id).end("FAILED", reason=reason, wait_s=SHORT_WAIT_S)


def note_end(folder: Path, run_id: str, uri: str, status: str, tags: Mapping[str, str]) -> None:
    """Notes how a run has ended, for `sync` to deliver, without asking its store.

    Args:
        folder: of the run.
        run_id: of the run.
        uri: of its store.
        status: as MLflow calls it.
        tags: to set.
    """
    with contextlib.closing(Spool.begin(folder, Address(run_id, absolute(uri)))) as spool:
        if tags:
            spool.add(tags=tags_of(tags))
        spool.add(status=(status, now_ms()))

"""Upload the entries that past runs could not, because the store was unreachable or their process died."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from armscan.config.trust import TRUST
from armscan.errors import FolderInUseError, TrackingError, UntrustedError
from armscan.tracking.outbox import CHANNELS, ENDED, Outbox, now_ms, outbox_files
from armscan.tracking.pending_runs import PendingRun, forget, pending_runs
from armscan.tracking.tags import FAILURE_TAG, FOLDER_TAG
from armscan.tracking.tracking_store import NOT_THERE, TrackingStore, reason_in
from armscan.tracking.uploader import upload
from armscan.utils.log import log
from armscan.utils.processes import ProcessInfo

if TYPE_CHECKING:
    from mlflow.entities import Run

PROCESS_DIED, FOLDER_REMOVED = "its process died", "its process died, and its folder was removed"
IN_USE = "it is still in progress"
# Stores whose pending entries this process has looked for.
_looked_for: set[str] = set()


@dataclass(frozen=True)
class Upload:
    """Outcome of uploading the entries of a run.

    Args:
        folder: The run's folder.
        run_id: MLflow run ID; None if it could not be read, as when another process holds the outbox.
        n_entries: Number of entries uploaded now.
        left: Reason why some entries are not uploaded; None if all are.
    """

    folder: Path
    run_id: str | None
    n_entries: int
    left: str | None


def sync(folder: Path, opened: Callable[[str], TrackingStore], *, trust: bool = False) -> list[Upload]:
    """Upload the pending entries of all runs in a folder, recursively.

    Args:
        folder: Folder of a run, of a study, or above them.
        opened: Function that opens a store by its address.
        trust: Whether to write to runs that this machine has not recorded and whose tag names another folder, and to
            upload files outside of a run's folder. Default: False.

    Returns:
        The outcome for each run that had entries left, is in use, or has a damaged outbox.
    """
    place = folder.resolve()
    removed = [
        each.outbox
        for each in pending_runs().values()
        if each.outbox.resolve().is_relative_to(place) and not each.outbox.exists()
    ]
    return _synced([*outbox_files(folder), *removed], opened, trust=trust)


def _synced(files: Iterable[Path], opened: Callable[[str], TrackingStore], *, trust: bool) -> list[Upload]:
    uploads: list[Upload] = []
    stores: dict[str, TrackingStore | TrackingError] = {}
    waiting = deque(files)
    while waiting:
        file, run_id = waiting.popleft(), None
        try:
            with contextlib.closing(Outbox(file, timeout_s=0.0)) as outbox:
                run_id, uri = outbox.address.run_id, outbox.address.uri
                is_dead = (pending := _pending_of(file)) is not None and pending.is_dead
                is_open = is_dead and outbox.status not in ENDED and not _is_tracked_beside(file)
                if outbox.is_uploaded and not is_open:
                    continue
                if isinstance(store := stores.get(uri) or _opened(opened, uri), TrackingError):
                    uploads.append(Upload(outbox.folder, run_id, 0, str(store)))
                else:
                    outcome, later = _upload_of(outbox, store, is_open=is_open, trust=trust)
                    uploads.append(outcome)
                    waiting += later
                stores[uri] = store
        except FileNotFoundError:
            pending = _pending_of(file)
            if pending is not None and pending.is_dead:
                left = _end_removed(file.stem, pending, opened)
                uploads += [Upload(file.parent.parent, file.stem, 0, left)] if left is not None else []
        except FolderInUseError:
            uploads.append(Upload(file.parent.parent, None, 0, IN_USE))
        except (OSError, TrackingError) as error:
            uploads.append(Upload(file.parent.parent, run_id, 0, str(error)))
    return uploads


def _pending_of(file: Path) -> PendingRun | None:
    """Return this machine's pending run with this outbox; None if there is none, or it has another outbox."""
    pending = PendingRun.of(file.stem)
    return pending if pending is not None and pending.outbox.resolve() == file.resolve() else None


def _is_tracked_beside(file: Path) -> bool:
    """Return whether another process tracks the run of an outbox, as several commands of a study do."""
    for other in _outboxes_beside(file):
        try:
            Outbox(other, timeout_s=0.0).close()
        except FolderInUseError:
            return True
        except (OSError, TrackingError):
            continue
    return False


def _outboxes_beside(file: Path) -> list[Path]:
    """Return the other outboxes of a run, each in the folder of another command of its study; links do not count."""
    file = file.resolve()
    found = file.parents[2].glob(f"*/{file.parent.name}/{file.name}")
    return sorted(each for each in found if each != file and each.resolve() == each and each.is_file())


def _upload_again(outbox: Outbox) -> list[Path]:
    """Mark the later outboxes of a run as not uploaded: their status and description replace those of this one.

    Raises:
        FolderInUseError: If another process tracks the run, which uploads this outbox at its end.
    """
    later = []
    for file in _outboxes_beside(outbox.file):
        # Damaged ones are reported where they are uploaded.
        with contextlib.suppress(OSError, TrackingError), contextlib.closing(Outbox(file, timeout_s=0.0)) as other:
            if other.status_ms > outbox.status_ms:
                other.mark("figures", 0)
                later.append((other.status_ms, file))
    return [file for _, file in sorted(later)]


def _end_removed(run_id: str, pending: PendingRun, opened: Callable[[str], TrackingStore]) -> str | None:
    """Close a run as FAILED: its process died and its folder was removed; return why that is impossible, if it is."""
    try:
        client = opened(pending.uri).mlflow
        run = client.get_run(run_id)
        if run.info.status == "RUNNING" and run.info.lifecycle_stage == "active":
            client.set_tag(run_id, FAILURE_TAG, FOLDER_REMOVED)
            client.set_terminated(run_id, "FAILED")
    # Any error of the store: the next start tries again, unless the store has no such run.
    except Exception as error:
        if getattr(error, "error_code", None) != NOT_THERE:
            return reason_in(error)
    forget(run_id)
    return None


def _opened(opened: Callable[[str], TrackingStore], uri: str) -> TrackingStore | TrackingError:
    """Open a store, or return the error, so that the next run does not wait for the store again."""
    try:
        return opened(uri)
    except (TrackingError, UntrustedError) as error:
        return TrackingError(str(error))


def _upload_of(outbox: Outbox, store: TrackingStore, *, is_open: bool, trust: bool) -> tuple[Upload, Sequence[Path]]:
    """Upload an outbox; return the outcome, and the later outboxes of the run, which must be uploaded again."""
    n_entries, left = 0, None
    try:
        run = store.get_run(outbox.address.run_id)
        store.check_artifacts_of(run)
        if not trust:
            _check_own(outbox, run)
        # First, so that an interruption cannot leave an older status or description in the store.
        later = _upload_again(outbox)
        if is_open:
            _end(outbox, run)
    except FolderInUseError:
        raise
    # Any error of the store, or an untrusted folder.
    except Exception as error:
        return Upload(outbox.folder, outbox.address.run_id, 0, reason_in(error)), ()
    for channel in CHANNELS:
        try:
            n_entries += upload(outbox, store.mlflow, channel, is_whole=False, trust=trust)
        # Any error of the store: refused entries stay in the outbox, and the next channel may be accepted.
        except Exception as error:
            left = reason_in(error)
    return Upload(outbox.folder, outbox.address.run_id, n_entries, left), later


def _end(outbox: Outbox, run: Run) -> None:
    """Add the end of a run whose process died: FAILED, unless the store has a later one, as of an interrupted grid."""
    # A resumed run has begun again.
    begun_ms = outbox.status_ms
    if run.info.status in ENDED and run.info.end_time is not None and run.info.end_time >= begun_ms:
        outbox.add(status=(run.info.status, run.info.end_time))
    else:
        # It died after its last metric; nobody knows when, if it has none.
        times_ms = (point[2] for each in outbox.entries() for point in each.get("metrics", ()))
        ended_ms = max(times_ms, default=now_ms())
        outbox.add(tags={FAILURE_TAG: PROCESS_DIED})
        outbox.add(status=("FAILED", max(ended_ms, begun_ms)))


def _check_own(outbox: Outbox, run: Run) -> None:
    """Raise `UntrustedError` unless the run was tracked from this folder, which could name any other."""
    folder, noted = outbox.folder.resolve(), run.data.tags.get(FOLDER_TAG)
    # Of the commands of a study, the last to begin is noted.
    pending = PendingRun.of(outbox.address.run_id)
    own = () if pending is None else (pending.outbox.resolve(), *_outboxes_beside(pending.outbox))
    if noted != str(folder) and outbox.file.resolve() not in own:
        raise UntrustedError(
            f"the run was not tracked from here on this machine, and its own folder is {noted or 'not known'}; if you "
            f"trust the author of {folder}, add {TRUST}"
        )


def upload_pending(store: TrackingStore) -> None:
    """Upload what earlier runs on this machine have left for a store, in the background, once per process."""
    if store.uri not in _looked_for:
        _looked_for.add(store.uri)
        threading.Thread(target=_upload_pending, args=(store,), name="pending", daemon=True).start()


def _upload_pending(store: TrackingStore) -> None:
    def opened(uri: str) -> TrackingStore:
        if uri != store.uri:
            raise TrackingError(f"{uri} is another store")
        return store

    here = ProcessInfo.current()
    for run_id, pending in pending_runs().items():
        is_there = pending.outbox.exists()
        uploads = _synced(sorted([pending.outbox, *_outboxes_beside(pending.outbox)]), opened, trust=False)
        for each in uploads:
            if each.n_entries:
                entries = "1 entry" if each.n_entries == 1 else f"{each.n_entries} entries"
                log(f"run {each.run_id}: uploaded {entries} that it had left")
        # A run in progress stays pending. So does one of another machine that shares this cache, as its folder may
        # be local to that machine. A process of an earlier boot has ended; an earlier version recorded no process.
        process = pending.process
        has_ended = not process.host or (process.host == here.host and process.boot != here.boot)
        is_over = (is_there or has_ended) and not _is_tracked_beside(pending.outbox)
        if is_over and all(each.left is None for each in uploads):
            forget(run_id)

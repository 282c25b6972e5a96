"""Notes of this machine on runs whose metrics are not yet uploaded, so that the next start finds them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from armscan.tracking.outbox import Outbox
from armscan.utils.files import atomic_write, cache_folder

FOLDER = "undelivered"


def note(outbox: Outbox) -> None:
    """Note that a run has something to upload."""
    # Nothing is lost without the note: `armscan runs sync` finds it.
    with contextlib.suppress(OSError):
        file = _note_of(outbox.address.run_id)
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(file, lambda opened: opened.write(os.fsencode(outbox.file.absolute())))


def forget(run_id: str) -> None:
    """Remove the note of a run: everything is uploaded, or the run is removed."""
    with contextlib.suppress(OSError):
        _note_of(run_id).unlink(missing_ok=True)


def noted() -> Iterator[tuple[Path, Path]]:
    """Iterate over the notes, with the files of their outboxes."""
    for file in sorted((cache_folder() / FOLDER).glob("[!.]*")):
        with contextlib.suppress(OSError):
            yield file, Path(os.fsdecode(file.read_bytes()))


def _note_of(run_id: str) -> Path:
    return cache_folder() / FOLDER / run_id

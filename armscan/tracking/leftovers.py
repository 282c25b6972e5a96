"""Where runs are that have something to be delivered: noted on this machine, so that the next start finds them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from armscan.files import cache_folder, write_whole
from armscan.tracking.spool import Spool

FOLDER = "undelivered"


def note(spool: Spool) -> None:
    """Notes that a run has something to be delivered."""
    # Where it cannot be noted, nothing is lost: `armscan.track sync` finds it.
    with contextlib.suppress(OSError):
        file = _note_of(spool.address.run_id)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, lambda opened: opened.write(os.fsencode(spool.file.absolute())))


def forget(run_id: str) -> None:
    """Notes that everything of a run is delivered, or that it is removed."""
    with contextlib.suppress(OSError):
        _note_of(run_id).unlink(missing_ok=True)


def noted() -> Iterator[tuple[Path, Path]]:
    """All notes, with the spools that they are of."""
    for file in sorted((cache_folder() / FOLDER).glob("[!.]*")):
        with contextlib.suppress(OSError):
            yield file, Path(os.fsdecode(file.read_bytes()))


def _note_of(run_id: str) -> Path:
    return cache_folder() / FOLDER / run_id

"""The files of a run's folder, and files that are there whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

# What training keeps in the folder of its run.
BEST_CHECKPOINT, LAST_CHECKPOINT = "best.pt", "last.pt"


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Writes a file beside its place and moves it there: a reader sees the old one or the new one, never half of one.

    Args:
        path: the file's place; its folder exists.
        write: writes the contents to the open file it is given.
    """
    # Where the place is a link, the file that it leads to is replaced, not the link.
    path = path.resolve()
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.unfinished")
    try:
        with unfinished.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, unfinished)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)

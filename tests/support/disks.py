"""A small disk for tests, which can be filled."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.requirements import unavailable

FILLER = "filler"


class Disk:
    """A small disk in memory.

    Args:
        folder: Folder that the disk is mounted on.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def fill(self) -> None:
        """Fill all space that is free now."""
        with (self.folder / FILLER).open("ab", buffering=0) as file:
            for n_bytes in (2**16, 1):
                try:
                    while file.write(bytes(n_bytes)) == n_bytes:
                        pass
                except OSError:
                    continue

    def empty(self) -> None:
        """Free the space that `fill` has taken."""
        (self.folder / FILLER).unlink()

    def enlarge(self, size: str) -> None:
        """Make it larger; `size` is as `mount` takes it, such as 16m."""
        subprocess.run(["mount", "-o", f"remount,size={size}", str(self.folder)], check=True)


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Disk]:
    """Mount a disk for the block; skip the test if none can be mounted.

    Args:
        folder: Folder that it is mounted on; created if missing.
        size: Size as `mount` takes it, such as 20m.
    """
    folder.mkdir(parents=True, exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        unavailable("a small disk cannot be mounted here: it needs root")
    try:
        yield Disk(folder)
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)

"""Volumes on disk as plain arrays that processes memory-map, so that a machine holds their voxels in memory once.

A file is a magic line, a line with the SHA-256 of all that follows, a line of JSON and, from the next page on, the
voxels. It is written under a temporary name and renamed, and verified in full whenever it is opened: a damaged or
partial file, or another version's, counts as missing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import mmap
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from filelock import FileLock, Timeout

from armscan.errors import InvalidValueError
from armscan.utils.files import UNFINISHED, atomic_write
from armscan.utils.log import log
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.volume import LabelVolume

MAGIC = b"armscan volume 2\n"
OF_VOLUMES = ".volume"
# Includes the voxel order: earlier versions, which used another, keep their own files.
SUFFIX = f".yxz{OF_VOLUMES}"
SHA256_CHARACTERS = 64
# Limit of the folder's size: the least recently opened files are evicted. Mapped voxels outlive their file.
DEFAULT_GIB = 16.0
LIMIT_VARIABLE = "ARMSCAN_CACHE_GIB"
# How long to wait for a process that is making a volume; a suspended one must not block all others.
MAX_WAITED_S = 60.0
UNFINISHED_FOR_S = 3600.0

Made = tuple[LabelVolume, Any]
"""A volume, and JSON-serialisable data to keep with it."""


def mapped_volume(path: Path, make: Callable[[], Made]) -> Made:
    """Return a volume from its file; without an intact file, make the volume and write it.

    Args:
        path: Path of the file; its name must encode everything that the volume depends on.
        make: Function that makes the volume, and the data to keep with it.

    Raises:
        OSError: If the file cannot be written.
    """
    if (found := open_mapped(path)) is not None:
        return found
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(Timeout):
            stack.enter_context(FileLock(path.parent / ".volumes.lock", timeout=MAX_WAITED_S))
        if (found := open_mapped(path)) is not None:
            return found
        volume, about = make()
        atomic_write(path, lambda file: _write(file, volume, about))
        _make_room(path)
    return open_mapped(path) or (volume, about)


def open_mapped(path: Path) -> Made | None:
    """Return a volume with the file's voxels, mapped, and the data kept with it; None if there is no intact file.

    Args:
        path: Path of the file.
    """
    try:
        with path.open("rb") as file:
            contents = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            # Another user's cache may be read-only.
            with contextlib.suppress(OSError):
                os.utime(file.fileno())
        start = len(MAGIC) + SHA256_CHARACTERS + 1
        digest = hashlib.sha256(memoryview(contents)[start:]).hexdigest()
        if contents[:start] != MAGIC + digest.encode() + b"\n":
            return None
        end = contents.find(b"\n", start) + 1
        kept = json.loads(contents[start:end])
    # An empty file cannot be mapped. An intact file's JSON needs no check: this version has written it.
    except (OSError, ValueError):
        return None
    labels = np.frombuffer(contents, np.uint8, offset=_next_page(end))
    n_x, n_y, n_z = kept["shape"]
    plane = kept["optimal_action"]
    volume = LabelVolume.from_checked(
        labels.reshape(n_y, n_x, n_z).transpose(1, 0, 2),
        spacing=tuple(kept["spacing"]),
        name=kept["name"],
        optimal_action=None if plane is None else ManipulatorAction.from_array(np.array(plane)),
        origin=tuple(kept["origin"]),
        direction=np.array(kept["direction"]),
        fingerprint=kept["fingerprint"],
    )
    return volume, kept["about"]


def _write(file: BinaryIO, volume: LabelVolume, about: Any) -> None:
    plane = volume.optimal_action
    kept = {
        "shape": volume.shape,
        "spacing": volume.spacing,
        "name": volume.name,
        "optimal_action": None if plane is None else plane.to_array().tolist(),
        "origin": volume.origin,
        "direction": volume.direction.tolist(),
        "fingerprint": volume.fingerprint,
        "about": about,
    }
    line = json.dumps(kept).encode() + b"\n"
    length = len(MAGIC) + SHA256_CHARACTERS + 1 + len(line)
    head = line + bytes(_next_page(length) - length)
    digest = hashlib.sha256(head)
    digest.update(volume.labels_yxz.data)
    file.write(MAGIC + digest.hexdigest().encode() + b"\n" + head)
    file.write(volume.labels_yxz.data)


def _next_page(n_bytes: int) -> int:
    return -(-n_bytes // mmap.PAGESIZE) * mmap.PAGESIZE


def _make_room(kept: Path) -> None:
    """Remove what killed processes left; evict the least recently opened files until the folder is within its limit."""
    limit = limit_bytes()
    for unfinished in kept.parent.glob(f".*{OF_VOLUMES}.*.{UNFINISHED}"):
        with contextlib.suppress(OSError):
            if unfinished.stat().st_mtime < time.time() - UNFINISHED_FOR_S:
                unfinished.unlink()
    files = []
    for file in kept.parent.glob(f"*{OF_VOLUMES}"):
        with contextlib.suppress(OSError):
            files.append((file.stat().st_mtime, file.stat().st_size, file))
    n_bytes = sum(size for _, size, _ in files)
    for _, size, file in sorted(files):
        if n_bytes <= limit:
            break
        if file != kept:
            # In a shared folder, another user's may stay.
            with contextlib.suppress(OSError):
                file.unlink(missing_ok=True)
                n_bytes -= size


def limit_bytes() -> float:
    """Return the size limit of a folder of volumes, in bytes: `$ARMSCAN_CACHE_GIB` GiB, default: 16.

    Raises:
        InvalidValueError: If the variable is not a number of 0 or more.
    """
    word = os.environ.get(LIMIT_VARIABLE) or str(DEFAULT_GIB)
    try:
        gib = float(word)
    except ValueError:
        gib = -1.0
    if not gib >= 0.0:
        raise InvalidValueError(
            f"the environment variable {LIMIT_VARIABLE} is {word!r}, but it must be a number of GiB, 0 or more"
        )
    return gib * 2**30


def cached_volume(path: Path, make: Callable[[], Made]) -> Made:
    """Return a volume as `mapped_volume` does, or one of this process alone if the file cannot be written."""
    try:
        return mapped_volume(path, make)
    except OSError as error:
        log(f"{path.parent}: volumes cannot be kept there ({error.strerror}), so that each process holds its own")
        return make()

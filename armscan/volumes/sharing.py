"""Volumes that several processes have in memory once."""

from __future__ import annotations

import mmap
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import InvalidValueError, VolumeError
from armscan.volumes.volume import LabelVolume

# A file system that is memory, where there is one.
MEMORY_FOLDER = Path("/dev/shm")


@contextmanager
def shared_volumes(volumes: Mapping[str, LabelVolume]) -> Iterator[dict[str, LabelVolume]]:
    """Puts the voxels of volumes where processes started inside the `with` can have them without a copy.

    Pickled, as it is on its way to another process, such a volume is only the name of a file, which the other process
    maps into its memory. So 64 environments in any number of processes hold each volume once:

        with shared_volumes(read_dataset(folder)) as volumes:
            envs = gymnasium.vector.AsyncVectorEnv([partial(make_armscan_env, volumes)] * 64)

    Args:
        volumes: by name.

    Yields:
        The same volumes, by the same names. After the `with` no other process can get them any more; those that have
        them keep them.

    Raises:
        InvalidValueError: if something else is among the volumes, or there is no room for them.
    """
    for name, volume in volumes.items():
        if not isinstance(volume, LabelVolume):
            raise InvalidValueError(f"volumes holds {volume!r} as {name!r}, but each must be a LabelVolume")
    folder = Path(tempfile.mkdtemp(prefix="armscan-", dir=MEMORY_FOLDER if MEMORY_FOLDER.is_dir() else None))
    try:
        yield {
            name: _shared(volume, folder / f"{place}.voxels") for place, (name, volume) in enumerate(volumes.items())
        }
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@dataclass(frozen=True, eq=False, repr=False)
class SharedVolume(LabelVolume):
    """A volume whose voxels are a file mapped into memory.

    Args:
        path: the file.
    """

    path: Path = Path()

    def __post_init__(self) -> None:
        """Checks nothing and copies nothing: it is made of a volume that was checked."""

    def __reduce__(self) -> tuple[Any, ...]:
        rest = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "labels"}
        return _opened, (self.shape, rest)


def _shared(volume: LabelVolume, path: Path) -> SharedVolume:
    try:
        path.write_bytes(volume.labels.data)
    except OSError as error:
        raise InvalidValueError(f"{path.parent}: there is no room for the voxels of {volume.name} ({error})") from error
    rest = {field.name: getattr(volume, field.name) for field in fields(LabelVolume) if field.name != "labels"}
    return _opened(volume.shape, {**rest, "path": path})


def _opened(shape: tuple[int, int, int], rest: dict[str, Any]) -> SharedVolume:
    try:
        with rest["path"].open("rb") as file:
            voxels = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise VolumeError(
            f"{rest['name']}: its shared voxels are gone ({error.strerror}); the process that shares them must be "
            "inside its `with shared_volumes(...)`"
        ) from error
    return SharedVolume(np.frombuffer(voxels, dtype=np.uint8).reshape(shape), **rest)

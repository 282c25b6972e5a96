"""Cache of phantoms on disk, so that each is made once per machine."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from weakref import WeakValueDictionary

from armscan.errors import InvalidValueError
from armscan.utils.files import cache_folder, sha256
from armscan.volumes import plane, volume
from armscan.volumes.mapped import SUFFIX, mapped_volume, open_mapped
from armscan.volumes.phantom import generate, tube, varied, wrist
from armscan.volumes.volume import LabelVolume

# Environments that are made one by one share their phantoms; unused ones are freed.
_IN_MEMORY: WeakValueDictionary[Path, LabelVolume] = WeakValueDictionary()


def load_phantoms(seeds: Iterable[int], cache_dir: Path | None = None, version: int = 1) -> dict[str, LabelVolume]:
    """Return phantoms by name; make and cache those that the cache lacks.

    Args:
        seeds: Seeds of the phantoms.
        cache_dir: Folder of the cache; see `load_phantom`. Default: None.
        version: Version of the anatomy; see `make_phantom`. Default: 1.

    Raises:
        InvalidValueError: As for `load_phantom`.
    """
    wanted = list(seeds)
    with ThreadPoolExecutor() as threads:
        # Existing files are verified on all cores; `there` keeps their volumes alive until they are returned.
        there = list(threads.map(lambda seed: _opened(_path(seed, cache_dir, version)), wanted))
    known: Iterable[tuple[int, LabelVolume | None]] = [*zip(wanted, there, strict=True)]
    if None in there and sys.stdout.isatty():
        # Deferred: needed once per machine.
        from rich.progress import track

        known = track(known, "making phantoms", total=len(wanted), transient=True)
    volumes = [volume or load_phantom(seed, cache_dir, version) for seed, volume in known]
    return {volume.name: volume for volume in volumes}


def load_phantom(seed: int, cache_dir: Path | None = None, version: int = 1) -> LabelVolume:
    """Return the phantom of a seed, from the cache if it is there; make and cache it otherwise.

    Args:
        seed: Seed of everything drawn; see `make_phantom`.
        cache_dir: Folder of the cache. Default: None, `$ARMSCAN_CACHE` or else the user's cache folder.
        version: Version of the anatomy; see `make_phantom`. Default: 1.

    Returns:
        The same volume as `make_phantom(seed, version)`, its voxels in memory once for all processes.

    Raises:
        InvalidValueError: As for `make_phantom`, or if the folder cannot be written.
    """
    path = _path(seed, cache_dir, version)
    volume = _opened(path)
    if volume is None:
        try:
            volume, _ = mapped_volume(path, lambda: (generate.make_phantom(seed, version), None))
        except OSError as error:
            raise InvalidValueError(
                f"{path.parent}: phantoms cannot be kept there ({error.strerror}); name another folder by "
                "data.cache_dir or the environment variable ARMSCAN_CACHE"
            ) from error
        _IN_MEMORY[path] = volume
    return volume


def _opened(path: Path) -> LabelVolume | None:
    """Return a phantom from this process's memory, or from its file; None if neither has it."""
    volume = _IN_MEMORY.get(path)
    if volume is None and (found := open_mapped(path)) is not None:
        _IN_MEMORY[path] = volume = found[0]
    return volume


def _path(seed: int, cache_dir: Path | None, version: int) -> Path:
    name = generate.phantom_name(seed, version)
    return (cache_dir or cache_folder()) / f"{name.removesuffix(str(seed))}{_generator_version()}-{seed}{SUFFIX}"


@cache
def _generator_version() -> str:
    """Return the fingerprint of the generator's sources, so that a change in them invalidates cached phantoms."""
    modules = (generate, tube, varied, wrist, plane, volume)
    return sha256(b"".join(Path(str(module.__file__)).read_bytes() for module in modules))[:12]

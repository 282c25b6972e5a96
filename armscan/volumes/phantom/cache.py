"""Phantoms kept on disk, so that each is made once a machine."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np

from armscan.errors import InvalidValueError
from armscan.utils.files import atomic_write, cache_folder
from armscan.volumes.phantom import generate, tube, varied, wrist
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.volume import LabelVolume

# Environments that are made one by one share their phantoms; those that nobody has any more are forgotten.
_IN_MEMORY: WeakValueDictionary[Path, LabelVolume] = WeakValueDictionary()


def load_phantoms(seeds: Iterable[int], cache_dir: Path | None = None, version: int = 1) -> dict[str, LabelVolume]:
    """Return the phantoms of the given seeds by name; see `load_phantom`."""
    return {volume.name: volume for volume in (load_phantom(seed, cache_dir, version) for seed in seeds)}


def load_phantom(seed: int, cache_dir: Path | None = None, version: int = 1) -> LabelVolume:
    """Return the phantom of a seed, from the cache where it is there, made and kept otherwise.

    Args:
        seed: as in `make_phantom`.
        cache_dir: where phantoms are kept; `$ARMSCAN_CACHE`, or else the user's cache folder, where it is None.
        version: as in `make_phantom`. Default: 1.

    Returns:
        The same volume as `make_phantom(seed, version)`.
    """
    name = generate.phantom_name(seed, version)
    path = (cache_dir or cache_folder()) / f"{name.removesuffix(str(seed))}{_generator_version()}-{seed}.npz"
    volume = _IN_MEMORY.get(path)
    if volume is None:
        _IN_MEMORY[path] = volume = _read_or_made(path, seed, version)
    return volume


def _read_or_made(path: Path, seed: int, version: int) -> LabelVolume:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            action = ManipulatorAction.from_array(arrays["optimal_action"])
            spacing = tuple(arrays["spacing"].tolist())
            return LabelVolume(arrays["labels"], spacing, generate.phantom_name(seed, version), optimal_action=action)
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        # Not there, or damaged: a cached phantom can always be made again.
        volume = generate.make_phantom(seed, version)
    assert volume.optimal_action is not None
    arrays = {"labels": volume.labels, "spacing": volume.spacing, "optimal_action": volume.optimal_action.to_array()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, lambda file: np.savez_compressed(file, allow_pickle=False, **arrays))
    except OSError as error:
        raise InvalidValueError(
            f"{path.parent}: phantoms cannot be kept there ({error.strerror}); name another folder by data.cache_dir "
            "or the environment variable ARMSCAN_CACHE"
        ) from error
    return volume


@cache
def _generator_version() -> str:
    """Fingerprint of the generator's sources, so that a changed generator never meets its old phantoms."""
    digest = hashlib.sha256()
    for module in (generate, tube, varied, wrist):
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()[:12]

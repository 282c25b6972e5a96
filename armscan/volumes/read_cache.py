"""Cache of labelmaps on this machine: each is read once, and held in memory once for all processes."""

from __future__ import annotations

import hashlib
import re
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from armscan.errors import VolumeError
from armscan.utils.files import cache_folder, sha256
from armscan.volumes import (
    header_checks,
    labelmap,
    nifti_header,
    orientation,
    plane,
    reading,
    resampling,
    segmentation,
    stored_voxels,
    volume,
    volume_report,
)
from armscan.volumes.header_checks import TEXT_HEADER_BYTES
from armscan.volumes.mapped import SUFFIX, Made, cached_volume
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.resampling import Spacing, resample
from armscan.volumes.volume import LabelVolume
from armscan.volumes.volume_report import StoredFile

# Modules that volumes depend on: a change in one invalidates the cache.
CODE = (
    *(header_checks, labelmap, nifti_header, orientation, reading, resampling, segmentation, stored_voxels),
    *(plane, volume, volume_report),
)
READERS = ("SimpleITK", "slicerio", "pynrrd")
# A text header that matches has its voxels in another file, or may have.
ELSEWHERE = {
    "nrrd": re.compile(rb"(?im)^data ?file"),
    "mha": re.compile(rb"\A(?!.*^ElementDataFile *= *LOCAL *\r?\n)", re.DOTALL | re.MULTILINE | re.IGNORECASE),
}
ELSEWHERE["mhd"] = ELSEWHERE["mha"]


def read_cached(
    path: Path, options: reading.ReadingOptions, optimal_action: ManipulatorAction | None
) -> tuple[LabelVolume, StoredFile]:
    """Read a volume as `read_stored` does, or find it in the cache.

    The cache key covers the file's name and contents, the options and the labelled plane. A file whose voxels lie in
    another file is not cached.

    Args:
        path: File of the volume.
        options: Reading options, such as crop and orientation.
        optimal_action: Labelled plane, in the volume's frame.

    Raises:
        VolumeError: If the file cannot be used, or changes while it is read.
    """
    from pydantic import TypeAdapter

    if (digest := _digest(path)) is None:
        return reading.read_stored(path, options, optimal_action=optimal_action)
    details = TypeAdapter(StoredFile)

    def make() -> Made:
        made, stored = reading.read_stored(path, options, optimal_action=optimal_action)
        if _digest(path) != digest:
            raise VolumeError(f"{path}: has changed while it was read")
        return made, details.dump_python(stored, mode="json")

    found, stored = cached_volume(_cached_path("labelmap", path.name, digest, options, optimal_action), make)
    return found, details.validate_python(stored)


def resample_cached(labelled: LabelVolume, spacing: Spacing) -> LabelVolume:
    """Resample a volume as `resample` does, or find it in the cache."""
    world_frame = labelled.origin, labelled.direction.tolist()
    path = _cached_path("resampled", labelled.name, labelled.fingerprint, world_frame, spacing)
    return cached_volume(path, lambda: (resample(labelled, spacing), None))[0]


def _digest(path: Path) -> str | None:
    """Return the SHA-256 of a file that holds its own voxels; None for any other, or if it cannot be read."""
    try:
        with path.open("rb") as file:
            elsewhere = ELSEWHERE.get(path.suffix[1:])
            if elsewhere is not None and elsewhere.search(file.read(TEXT_HEADER_BYTES)):
                return None
            file.seek(0)
            return hashlib.file_digest(file, "sha256").hexdigest()
    # Reading it reports what is wrong.
    except (OSError, ValueError):
        return None


def _cached_path(kind: str, *depends_on: Any) -> Path:
    key = sha256(repr((_code_version(), depends_on)).encode())
    return cache_folder() / f"{kind}-{key}{SUFFIX}"


@cache
def _code_version() -> str:
    readers = repr([version(package) for package in READERS]).encode()
    return sha256(readers + b"".join(Path(str(module.__file__)).read_bytes() for module in CODE))

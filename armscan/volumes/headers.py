"""What an image file's own header says, where the reading library would mend it in silence.

SimpleITK replaces a NaN, zero or negative spacing by another one and fills the missing end of a truncated NIfTI file
with zeros. Both would end in wrong figures, so they are looked for here before the file is read.
"""

from __future__ import annotations

import gzip
import math
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from armscan.errors import VolumeError

TEXT_HEADER_BYTES = 65536
# Bytes of a voxel by the code of its type; the header's own figure can be anything and is not what is read.
NIFTI_VOXEL_BYTES = {2: 1, 4: 2, 8: 4, 16: 4, 64: 8, 256: 1, 512: 2, 768: 4, 1024: 8, 1280: 8}


def check_nifti(path: Path) -> None:
    """Raises `VolumeError` if a NIfTI file is cut off or its spacing is not finite and positive."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            header = file.read(540)
            n_bytes = len(header) + _count_bytes(file)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise VolumeError(f"{path}: the file is truncated or damaged ({error})") from error
    for order in "<>":
        if len(header) >= 348 and struct.unpack_from(f"{order}i", header)[0] == 348:
            dims = struct.unpack_from(f"{order}8h", header, 40)
            type_code = struct.unpack_from(f"{order}h", header, 70)[0]
            spacing = struct.unpack_from(f"{order}8f", header, 76)[1:4]
            offset = struct.unpack_from(f"{order}f", header, 108)[0]
            break
        if len(header) >= 540 and struct.unpack_from(f"{order}i", header)[0] == 540:
            dims = struct.unpack_from(f"{order}8q", header, 16)
            type_code = struct.unpack_from(f"{order}h", header, 12)[0]
            spacing = struct.unpack_from(f"{order}8d", header, 104)[1:4]
            offset = struct.unpack_from(f"{order}q", header, 168)[0]
            break
    else:
        raise VolumeError(f"{path}: the file does not begin with a NIfTI header")
    # Any other type is no labelmap's, and is refused after reading.
    expected = offset + math.prod(dims[1 : 1 + dims[0]]) * NIFTI_VOXEL_BYTES.get(type_code, 1)
    if not n_bytes >= expected or offset < 0:
        raise VolumeError(
            f"{path}: the file is truncated: it holds {n_bytes} bytes, but its header promises {expected:g}"
        )
    # Spacings of axes that the image does not have are often 0, and mean nothing.
    _check_spacing(path, spacing[: dims[0]])


def check_nrrd(path: Path) -> None:
    """Raises `VolumeError` if a NRRD header gives no spacing, or one that is not finite and positive."""
    header = _text_header(path).replace(b"\r\n", b"\n").partition(b"\n\n")[0]
    given = re.search(rb"^spacings:(.*)$", header, re.MULTILINE | re.IGNORECASE)
    directions = re.search(rb"^space directions:(.*)$", header, re.MULTILINE | re.IGNORECASE)
    if given:
        _check_spacing(path, [_number(word) for word in given.group(1).split()])
    elif directions:
        vectors = re.findall(rb"\(([^)]*)\)|(none)", directions.group(1))
        # The layers of a segmentation have no direction; an axis of space must have one.
        if len(vectors) > 3 and vectors[0][1]:
            vectors = vectors[1:]
        _check_spacing(path, [math.hypot(*map(_number, v.split(b","))) if v else math.nan for v, _ in vectors])
    else:
        raise VolumeError(f"{path}: the file gives no spacing (spacings or space directions), but a volume needs one")


def check_metaimage(path: Path) -> None:
    """Raises `VolumeError` if a MetaImage header gives no spacing, or one that is not finite and positive."""
    header = _text_header(path).partition(b"ElementDataFile")[0]
    given = re.search(rb"^Element(?:Spacing|Size)\s*=(.*)$", header, re.MULTILINE | re.IGNORECASE)
    if not given:
        raise VolumeError(f"{path}: the file gives no spacing (ElementSpacing), but a volume needs one")
    _check_spacing(path, [_number(word) for word in given.group(1).split()])


# By ending; the first that fits a name is the file's.
CHECKS: dict[str, Callable[[Path], None]] = {
    ".seg.nrrd": check_nrrd,
    ".nii.gz": check_nifti,
    ".nii": check_nifti,
    ".nrrd": check_nrrd,
    ".mha": check_metaimage,
    ".mhd": check_metaimage,
}


def _count_bytes(file: BinaryIO | gzip.GzipFile) -> int:
    n_bytes = 0
    while chunk := file.read(1 << 20):
        n_bytes += len(chunk)
    return n_bytes


def _text_header(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(TEXT_HEADER_BYTES)


def _number(word: bytes) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def _check_spacing(path: Path, spacing: tuple[float, ...] | list[float]) -> None:
    if not all(math.isfinite(step) and step > 0 for step in spacing):
        received = ", ".join(f"{step:g}" for step in spacing)
        raise VolumeError(f"{path}: the spacing in the file is ({received}) mm, but each must be finite and above 0")

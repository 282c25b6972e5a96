"""What an image file's own header says, where the reading library would mend it in silence.

SimpleITK replaces a NaN, zero, negative or missing spacing by another one, fills the missing end of a truncated NIfTI
file with zeros, and makes voxels that are NaN or infinite 0. All would end in wrong figures, so they are looked for
here before the file is read.
"""

from __future__ import annotations

import gzip
import math
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from armscan.errors import VolumeError

TEXT_HEADER_BYTES = 65536
# Bytes of a voxel by the code of its type; the header's own figure can be anything and is not what is read.
NIFTI_VOXEL_BYTES = {2: 1, 4: 2, 8: 4, 16: 4, 64: 8, 256: 1, 512: 2, 768: 4, 1024: 8, 1280: 8}
METAIMAGE_FIELDS = (b"NDims", b"DimSize", b"ElementType", b"ElementDataFile")
METAIMAGE_VOXEL_BYTES = {
    b"MET_CHAR": 1,
    b"MET_UCHAR": 1,
    b"MET_SHORT": 2,
    b"MET_USHORT": 2,
    b"MET_INT": 4,
    b"MET_UINT": 4,
    b"MET_LONG_LONG": 8,
    b"MET_ULONG_LONG": 8,
    b"MET_FLOAT": 4,
    b"MET_DOUBLE": 8,
}
NIFTI_FLOATS = {16: "f4", 64: "f8"}
# No header is longer, extensions included.
LARGEST_OFFSET = 1 << 24


def check_nifti(path: Path) -> None:
    """Raise `VolumeError` if a NIfTI file is cut off, its spacing not finite and positive, or a voxel not finite."""
    try:
        with _opened(path) as file:
            header = _nifti_header(path, file.read(540))
        with _opened(path) as file:
            n_bytes = len(file.read(max(0, int(header.offset))))
            float_type = NIFTI_FLOATS.get(header.type_code)
            while chunk := file.read(1 << 20):
                n_bytes += len(chunk)
                if float_type and n_bytes <= header.n_bytes and not _all_finite(chunk, header.order + float_type):
                    raise VolumeError(f"{path}: holds a voxel that is NaN or infinite, but a labelmap holds numbers")
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise VolumeError(f"{path}: the file is truncated or damaged ({error})") from error
    if not n_bytes >= header.n_bytes:
        raise VolumeError(
            f"{path}: the file is truncated: it holds {n_bytes} bytes, but its header promises {header.n_bytes:g}"
        )
    _check_spacing(path, header.spacing)


@dataclass(frozen=True)
class _NiftiHeader:
    """What is needed of it; `n_bytes` is how long the whole file must be, `order` that of the bytes."""

    order: str
    type_code: int
    spacing: tuple[float, ...]
    offset: float
    n_bytes: float


def _nifti_header(path: Path, header: bytes) -> _NiftiHeader:
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
    if not 0 <= offset < LARGEST_OFFSET or not 1 <= dims[0] <= 7 or min(dims[1 : 1 + dims[0]]) < 1:
        raise VolumeError(
            f"{path}: the header is damaged: its dimensions are {dims}, its voxels begin at byte {offset:g}"
        )
    # Any other type is no labelmap's, and is refused after reading.
    n_bytes = offset + math.prod(dims[1 : 1 + dims[0]]) * NIFTI_VOXEL_BYTES.get(type_code, 1)
    # Spacings of axes that the image does not have are often 0, and mean nothing.
    return _NiftiHeader(order, type_code, spacing[: dims[0]], offset, n_bytes)


def check_nrrd(path: Path) -> None:
    """Raise `VolumeError` if a NRRD header gives no spacing, or one that is not finite and positive."""
    header = _nrrd_header(path)
    given, directions = _nrrd_field(header, b"spacings"), _nrrd_field(header, b"space directions")
    if given is not None:
        _check_spacing(path, [_number(word) for word in given.split()])
    elif directions is not None:
        vectors = re.findall(rb"\(([^)]*)\)|(none)", directions)
        # The layers of a segmentation have no direction; an axis of space must have one.
        if len(vectors) > 3 and vectors[0][1]:
            vectors = vectors[1:]
        _check_spacing(path, [math.hypot(*map(_number, v.split(b","))) if v else math.nan for v, _ in vectors])
    else:
        raise VolumeError(f"{path}: the file gives no spacing (spacings or space directions), but a volume needs one")


def check_segmentation(path: Path) -> None:
    """Raise `VolumeError` if the header of a segmentation does not say where it lies, or has an impossible spacing."""
    check_nrrd(path)
    header = _nrrd_header(path)
    for name in ("space", "space directions", "space origin", "kinds"):
        if _nrrd_field(header, name.encode()) is None:
            raise VolumeError(f"{path}: the file gives no {name}, but a segmentation needs it")


def check_metaimage(path: Path) -> None:
    """Raise `VolumeError` if a MetaImage is cut off, or its header gives no finite and positive spacing."""
    text = _text_header(path)
    start, found, rest = text.partition(b"ElementDataFile")
    fields = {
        name.strip(): value.strip()
        for name, _, value in (line.partition(b"=") for line in (start + found + rest.partition(b"\n")[0]).splitlines())
    }
    if missing := [name for name in METAIMAGE_FIELDS if name not in fields]:
        raise VolumeError(f"{path}: the header gives no {missing[0].decode()}, but a MetaImage needs it")
    spacing = fields.get(b"ElementSpacing", fields.get(b"ElementSize"))
    if spacing is None:
        raise VolumeError(f"{path}: the file gives no spacing (ElementSpacing), but a volume needs one")
    _check_spacing(path, [_number(word) for word in spacing.split()])
    data_file = path if fields[b"ElementDataFile"] == b"LOCAL" else path.parent / _decoded(fields[b"ElementDataFile"])
    voxel_bytes = METAIMAGE_VOXEL_BYTES.get(fields[b"ElementType"])
    # The other kinds are met by the reading library.
    if fields.get(b"CompressedData", b"False") != b"False" or voxel_bytes is None or not data_file.is_file():
        return
    n_header = len(start + found) + rest.index(b"\n") + 1 if data_file == path and b"\n" in rest else 0
    n_bytes = data_file.stat().st_size - n_header
    expected = math.prod(_number(word) for word in fields[b"DimSize"].split()) * voxel_bytes
    if not n_bytes >= expected:
        raise VolumeError(
            f"{path}: the file is truncated: it holds {n_bytes} bytes of voxels, but its header promises {expected:g}"
        )


# By ending; the first that fits a name is the file's.
CHECKS: dict[str, Callable[[Path], None]] = {
    ".seg.nrrd": check_segmentation,
    ".nii.gz": check_nifti,
    ".nii": check_nifti,
    ".nrrd": check_nrrd,
    ".mha": check_metaimage,
    ".mhd": check_metaimage,
}


def _opened(path: Path) -> BinaryIO | gzip.GzipFile:
    return gzip.open(path) if path.suffix == ".gz" else path.open("rb")


def _all_finite(chunk: bytes, float_type: str) -> bool:
    """Whether voxels are; the reading library makes others 0 without a word. A voxel cut off at the end is left out."""
    whole = len(chunk) - len(chunk) % np.dtype(float_type).itemsize
    return bool(np.isfinite(np.frombuffer(chunk[:whole], float_type)).all())


def _text_header(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(TEXT_HEADER_BYTES)


def _nrrd_header(path: Path) -> bytes:
    """Return the lines before the first empty one, behind which the voxels begin."""
    return _text_header(path).replace(b"\r\n", b"\n").partition(b"\n\n")[0]


def _nrrd_field(header: bytes, name: bytes) -> bytes | None:
    field = re.search(rb"^" + name + rb":(?!=)(.*)$", header, re.MULTILINE | re.IGNORECASE)
    return field.group(1) if field else None


def _decoded(name: bytes) -> str:
    return name.decode(errors="surrogateescape").replace("\0", "")


def _number(word: bytes) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def _check_spacing(path: Path, spacing: tuple[float, ...] | list[float]) -> None:
    if not all(math.isfinite(step) and step > 0 for step in spacing):
        received = ", ".join(f"{step:g}" for step in spacing)
        raise VolumeError(f"{path}: the spacing in the file is ({received}) mm, but each must be finite and above 0")

"""Check NRRD files and MetaImages for errors that SimpleITK silently repairs or ignores.

SimpleITK replaces a NaN, zero, negative or missing spacing by another one, and reads damaged compressed voxels. Both
would lead to wrong results, so files are checked here before they are read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from armscan.errors import VolumeError, listed
from armscan.volumes.nifti_header import check_nifti
from armscan.volumes.stored_voxels import GZIP, GZIP_OR_ZLIB, StoredVoxels, check_spacing, check_stored, count_voxels

TEXT_HEADER_BYTES = 1 << 20
METAIMAGE_TYPES = {
    "MET_CHAR": 1,
    "MET_UCHAR": 1,
    "MET_SHORT": 2,
    "MET_USHORT": 2,
    "MET_INT": 4,
    "MET_UINT": 4,
    "MET_LONG_LONG": 8,
    "MET_ULONG_LONG": 8,
    "MET_FLOAT": 4,
    "MET_DOUBLE": 8,
}
METAIMAGE_FIELDS = ("NDims", "DimSize", "ElementType", "ElementDataFile")
# Fields of one meaning; SimpleITK uses one of them.
POSITIONS, DIRECTIONS = ("Offset", "Position", "Origin"), ("TransformMatrix", "Rotation", "Orientation")
SPACINGS = ("ElementSpacing", "ElementSize")
# Of an axis of an NRRD file.
DIRECTION = r"\(([^()]*)\)|(none)"
# Without `signed`, `unsigned` and the suffix `_t`.
NRRD_TYPES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "short int": 2, "ushort": 2, "int16": 2}
NRRD_TYPES |= {"uint16": 2, "int": 4, "uint": 4, "int32": 4, "uint32": 4, "longlong": 8, "long long": 8}
NRRD_TYPES |= {"long long int": 8, "ulonglong": 8, "int64": 8, "uint64": 8, "float": 4, "double": 8}
# Units of length besides mm; the axis of a segmentation's layers may have any other.
OTHER_LENGTHS = {f"{prefix}{unit}" for prefix in ("", "centi", "micro", "nano") for unit in ("meter", "metre")}
OTHER_LENGTHS |= {f"{name}s" for name in OTHER_LENGTHS} | {"m", "cm", "um", "\u00b5m", "\u03bcm", "nm"}
OTHER_LENGTHS |= {"micron", "microns", "in", "inch", "inches"}
# ITK also writes what other formats said: `pixdim[1]` of NIfTI, `0008|0060` of DICOM.
METAIMAGE_FIELD = re.compile(r"[A-Za-z0-9_]+(\[[0-9]+\])?|[0-9A-Fa-f]{4}\|[0-9A-Fa-f]{4}")
# NRRD spaces that are not anatomical; SimpleITK reads them as left-posterior-superior.
NO_ANATOMY = ("scanner-xyz", "sxyz", "3d-right-handed", "3dr", "3d-left-handed", "3dl")
# Those that 3D Slicer writes, and slicerio reads.
SEGMENTATION_SPACES = ("left-posterior-superior", "right-anterior-superior")
NRRD_ENCODINGS = {"raw": None, "gzip": GZIP, "gz": GZIP}


def check_nrrd(path: Path, needed: Sequence[str] = ()) -> None:
    """Check an NRRD file.

    Args:
        path: File to check.
        needed: Fields that it must have beside type, dimension, sizes and encoding. Default: none.

    Raises:
        VolumeError: If it is damaged, lacks a field, or gives no finite and positive spacing.
    """
    header, end, _ = _text_header(path).partition(b"\n\n")
    if b"\r\n" in header or not end:
        header, end, _ = _text_header(path).partition(b"\r\n\r\n")
    fields = {name.lower(): value for name, value in _fields(path, header, ":(?!=)").items()}
    _check_nrrd_spacing(path, fields)
    if (space := fields.get("space", "").lower()) in NO_ANATOMY:
        raise VolumeError(
            f"{path}: space is {space}, which does not say where left, posterior and superior are; it must be "
            "left-posterior-superior or another anatomical space, or absent"
        )
    for name in ("space units", "units"):
        _check_units(path, name, re.findall(r'"([^"]*)"', fields.get(name, "")))
    _check_finite(path, "space origin", fields, re.findall(r"[^\s(),]+", fields.get("space origin", "")))
    for name in ("type", "dimension", "sizes", "encoding", *needed):
        if name not in fields:
            raise VolumeError(f"{path}: the file gives no {name}, but it must")
    if needed and fields["space"] not in SEGMENTATION_SPACES:
        raise VolumeError(f"{path}: space is {fields['space']}, but a segmentation's is {listed(SEGMENTATION_SPACES)}")
    voxel_bytes = NRRD_TYPES.get(re.sub("^(un)?signed |_t$", "", fields["type"]))
    sizes = [_whole(path, "sizes", word) for word in fields["sizes"].split()]
    if voxel_bytes is None or fields["dimension"] != str(len(sizes)):
        raise VolumeError(_no_labelmap(path, fields["dimension"], sizes, fields["type"]))
    skips = {fields.get(name, "0") for name in ("line skip", "lineskip", "byte skip", "byteskip")}
    encoding = fields["encoding"].lower()
    if encoding not in NRRD_ENCODINGS or skips != {"0"}:
        raise VolumeError(
            f"{path}: the encoding is {encoding!r} with skips of {listed(sorted(skips))}, but only "
            f"{listed(NRRD_ENCODINGS)} without skips can be checked, and are read"
        )
    data_file = fields.get("data file", fields.get("datafile"))
    stored = StoredVoxels(
        path if data_file is None else _beside(path, data_file),
        count_voxels(path, sizes) * voxel_bytes,
        offset=len(header) + len(end) if data_file is None else 0,
        compression=NRRD_ENCODINGS[encoding],
    )
    check_stored(path, stored)


def check_metaimage(path: Path) -> None:
    """Raise `VolumeError` if a MetaImage is damaged, or its header gives no finite and positive spacing."""
    text = _text_header(path)
    start, key, rest = text.partition(b"ElementDataFile")
    header = start + key + rest.partition(b"\n")[0] + b"\n"
    fields = _fields(path, header, "=")
    if wrong := [name for name in fields if not METAIMAGE_FIELD.fullmatch(name)]:
        raise VolumeError(f"{path}: the header is damaged: it has a field {wrong[0]!r}")
    if len(fields) < len(header.split(b"\n")) - 1:
        raise VolumeError(f"{path}: the header is damaged: each line must be a field of its own, with a value")
    if missing := [name for name in METAIMAGE_FIELDS if name not in fields]:
        raise VolumeError(f"{path}: the header gives no {missing[0]}, but a MetaImage needs it")
    _check_n_numbers(path, fields)
    _check_places(path, fields)
    check_stored(path, _stored_metaimage(path, fields, header))


def _check_places(path: Path, fields: Mapping[str, str]) -> None:
    """Check the fields of a MetaImage that say where its voxels lie."""
    spacing = fields.get("ElementSpacing", fields.get("ElementSize"))
    if spacing is None:
        raise VolumeError(f"{path}: the file gives no spacing (ElementSpacing), but a volume needs one")
    check_spacing(path, [_number(word) for word in spacing.split()])
    _check_units(path, "DistanceUnits", [fields.get("DistanceUnits", "")])
    for name in POSITIONS:
        _check_finite(path, name, fields, fields.get(name, "").split())
    for names in (POSITIONS, DIRECTIONS):
        stated = {name: [_number(word) for word in fields[name].split()] for name in names if name in fields}
        if any(numbers != next(iter(stated.values())) for numbers in stated.values()):
            raise VolumeError(f"{path}: {listed(stated)} differ, but only one of them is used: remove the wrong one")


def _stored_metaimage(path: Path, fields: Mapping[str, str], header: bytes) -> StoredVoxels:
    """Check the fields of a MetaImage that say how its voxels are stored, and return where they are."""
    sizes = [_whole(path, "DimSize", word) for word in fields["DimSize"].split()]
    kind = fields["ElementType"]
    if kind not in METAIMAGE_TYPES or fields["NDims"] != str(len(sizes)):
        raise VolumeError(_no_labelmap(path, fields["NDims"], sizes, kind))
    is_compressed = _is_true(path, fields, "CompressedData", default=False)
    if not _is_true(path, fields, "BinaryData", default=True):
        raise VolumeError(f"{path}: BinaryData is False, but only binary voxels can be checked, and are read")
    for name in ("BinaryDataByteOrderMSB", "ElementByteOrderMSB"):
        _is_true(path, fields, name, default=False)
    is_local = fields["ElementDataFile"] in ("LOCAL", "Local", "local")
    file = path if is_local else _beside(path, fields["ElementDataFile"])
    offset = len(header) if is_local else 0
    if fields.get("HeaderSize", "0") != "0":
        raise VolumeError(f"{path}: HeaderSize is {fields['HeaderSize']}, but it must be 0 or absent")
    n_compressed = str(file.stat().st_size - offset)
    # Without it, SimpleITK cannot read compressed voxels that follow their header.
    n_promised = fields.get("CompressedDataSize", "no number" if is_local else n_compressed)
    if is_compressed and n_promised != n_compressed:
        raise VolumeError(
            f"{path}: the file is truncated or damaged: it holds {n_compressed} compressed bytes of voxels, but its "
            f"header promises {n_promised}"
        )
    if (n_values := fields.get("ElementNumberOfChannels", "1")) != "1":
        raise VolumeError(f"{path}: ElementNumberOfChannels is {n_values}, but a labelmap has one value per voxel")
    return StoredVoxels(
        file,
        count_voxels(path, sizes) * METAIMAGE_TYPES[kind],
        offset=offset,
        compression=GZIP_OR_ZLIB if is_compressed else None,
    )


# By suffix; the first one that a file name ends with applies.
CHECKS: dict[str, Callable[[Path], None]] = {
    # A segmentation must also state its position in the world.
    ".seg.nrrd": partial(check_nrrd, needed=("space", "space directions", "space origin", "kinds")),
    ".nii.gz": check_nifti,
    ".nii": check_nifti,
    ".nrrd": check_nrrd,
    ".mha": check_metaimage,
    ".mhd": check_metaimage,
}


def _text_header(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(TEXT_HEADER_BYTES)


def _fields(path: Path, header: bytes, separator: str) -> dict[str, str]:
    """Return the fields of a header by name; the first of those with the same name."""
    text = header.decode(errors="surrogateescape").replace("\r\n", "\n")
    # SimpleITK takes some control characters for the end of a line or of the text.
    if re.search(r"[\0-\x08\x0b-\x1f\x7f]", text):
        raise VolumeError(f"{path}: the header is damaged: it contains bytes that are not text")
    lines = [re.split(separator, line, maxsplit=1) for line in text.split("\n")]
    return {line[0].strip(): line[1].strip() for line in reversed(lines) if len(line) == 2}


def _check_n_numbers(path: Path, fields: Mapping[str, str]) -> None:
    """Raise `VolumeError` if a MetaImage field lacks numbers, which SimpleITK takes from the next line, or has more."""
    n_dimensions = _whole(path, "NDims", fields["NDims"])
    counts = dict.fromkeys((*SPACINGS, *POSITIONS, "CenterOfRotation"), n_dimensions)
    counts |= dict.fromkeys(DIRECTIONS, n_dimensions**2) | {"Color": 4}
    counts |= dict.fromkeys(("ElementMin", "ElementMax"), 1)
    counts |= dict.fromkeys(("ElementToIntensityFunctionSlope", "ElementToIntensityFunctionOffset"), 1)
    for name, count in counts.items():
        if name in fields and len(fields[name].split()) != count:
            raise VolumeError(f"{path}: {name} is {fields[name]!r}, but it must be {count} numbers")


def _check_nrrd_spacing(path: Path, fields: Mapping[str, str]) -> None:
    if "spacings" in fields:
        check_spacing(path, [_number(word) for word in fields["spacings"].split()])
    elif "space directions" in fields:
        directions = fields["space directions"]
        vectors = re.findall(DIRECTION, directions)
        if not vectors or re.sub(DIRECTION, "", directions).strip():
            raise VolumeError(
                f"{path}: space directions is {directions[:40]!r}, but it must be vectors such as (1,0,0), or none"
            )
        # The layer axis of a segmentation has no direction; a spatial axis must have one.
        if len(vectors) > 3 and vectors[0][1]:
            vectors = vectors[1:]
        check_spacing(path, [math.hypot(*map(_number, v.split(","))) if v else math.nan for v, _ in vectors])
    else:
        raise VolumeError(f"{path}: the file gives no spacing (spacings or space directions), but a volume needs one")


def _check_units(path: Path, name: str, units: Sequence[str]) -> None:
    """Raise `VolumeError` if a header states units of length other than mm, which SimpleITK ignores."""
    if other := [unit for unit in units if unit.strip().lower() in OTHER_LENGTHS]:
        raise VolumeError(f"{path}: {name} is {other[0]!r}, but only volumes in mm are read")


def _check_finite(path: Path, name: str, fields: Mapping[str, str], words: Sequence[str]) -> None:
    if not all(math.isfinite(_number(word)) for word in words):
        raise VolumeError(f"{path}: {name} is {fields[name]!r}, but it must be finite numbers")


def _beside(path: Path, name: str) -> Path:
    """Return the file of voxels that a header names; raise `VolumeError` if there is none of that name."""
    file = path.parent / name.replace("\0", "")
    if not file.is_file():
        raise VolumeError(f"{path}: its voxels are in {name!r}, but there is no such file; they must be in one file")
    return file


def _no_labelmap(path: Path, dimension: str, sizes: list[int], kind: str) -> str:
    received = f"{dimension} dimensions of {', '.join(map(str, sizes))} voxels of type {kind}"
    return f"{path}: has {received}, but a labelmap has 3, a size for each, and integers or floats"


def _is_true(path: Path, fields: Mapping[str, str], name: str, *, default: bool) -> bool:
    value = fields.get(name, str(default))
    if value.lower() not in ("true", "false"):
        raise VolumeError(f"{path}: {name} is {value!r}, but it must be True or False")
    return value.lower() == "true"


def _whole(path: Path, name: str, word: str) -> int:
    if not re.fullmatch("[0-9]{1,18}", word):
        raise VolumeError(f"{path}: {name} holds {word!r}, but it must be whole numbers")
    return int(word)


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan

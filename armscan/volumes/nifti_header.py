"""Headers of NIfTI files, checked before SimpleITK reads the file.

SimpleITK pads a truncated file with zeros, shifts the image if its voxels begin within the header, turns NaN and
infinite voxels into 0, and prints pages of output if the qform or sform is not finite.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import VolumeError
from armscan.volumes.stored_voxels import GZIP, StoredVoxels, check_spacing, check_stored, count_voxels, pieces

# Voxel types by their code; the header's own `bitpix` may be anything, and is ignored when voxels are read.
TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
# The `struct` format and the offset of each field, or of fields in a row.
LAYOUT = {
    "magic": ("4s", 344),
    "dim": ("8h", 40),
    "datatype": ("h", 70),
    "pixdim": ("8f", 76),
    "vox_offset": ("f", 108),
    "scl": ("2f", 112),
    "form_codes": ("2h", 252),
    "forms": ("18f", 256),
}
HEADER_BYTES, NIFTI_2_BYTES = 348, 540
MAGIC = b"n+1\0"
# After the header, four bytes say whether extensions follow.
VOXELS_FROM = HEADER_BYTES + 4
# No header is longer, extensions included.
MAX_OFFSET = 1 << 24
# Relative, between the spacings of pixdim and of the sform, both of which many programs round.
SPACING_TOLERANCE = 1e-3
# Between the forms (qform and sform): the cosines of the axes, and the origin in units of the smallest spacing.
COSINE_TOLERANCE, ORIGIN_TOLERANCE = 0.01, 0.1


def check_nifti(path: Path) -> None:
    """Raise `VolumeError` if a NIfTI file is damaged, contradicts itself, or has a form or voxel that is not finite."""
    order, fields = _header(path)
    (magic,), (n_dimensions, *sizes), (vox_offset,), (datatype,) = (
        fields[name] for name in ("magic", "dim", "vox_offset", "datatype")
    )
    if magic != MAGIC:
        raise VolumeError(f"{path}: the header is damaged, or of a pair of files (.hdr and .img), which cannot be read")
    if not VOXELS_FROM <= vox_offset < MAX_OFFSET or vox_offset != int(vox_offset):
        raise VolumeError(f"{path}: the header ends at byte {VOXELS_FROM}, but its voxels begin at byte {vox_offset:g}")
    if not 1 <= n_dimensions <= 7 or datatype not in TYPES:
        raise VolumeError(
            f"{path}: has {n_dimensions} dimensions and voxels of type {datatype}, but a labelmap has 3, and integers "
            "or floats"
        )
    # SimpleITK applies them to the labels; some programs write NaN for none.
    slope, inter = fields["scl"]
    if (slope not in (0.0, 1.0) and not math.isnan(slope)) or (inter != 0.0 and not math.isnan(inter)):
        raise VolumeError(
            f"{path}: its voxels are scaled: scl_slope is {slope:g}, but must be 0 or 1, and scl_inter is {inter:g}, "
            "but must be 0: save the labels unscaled"
        )
    # The spacings of unused axes are often 0 and mean nothing.
    check_spacing(path, fields["pixdim"][1:4][:n_dimensions])
    if not all(map(math.isfinite, fields["forms"])):
        raise VolumeError(f"{path}: its qform or sform holds a NaN or an infinity")
    of_qform, of_sform = (code > 0 for code in fields["form_codes"])
    if of_sform:
        _check_spacings_agree(path, fields["pixdim"][1:4][:n_dimensions], fields["forms"][6:])
    if of_qform and of_sform and n_dimensions >= 3:
        _check_forms_agree(path, fields["pixdim"][:4], fields["forms"])
    voxel = np.dtype(order + TYPES[datatype])
    check_stored(
        path,
        StoredVoxels(
            path,
            int(vox_offset) + count_voxels(path, sizes[:n_dimensions]) * voxel.itemsize,
            compression=_compression(path),
            n_before=int(vox_offset),
            finite=voxel.str if voxel.kind == "f" else None,
        ),
    )


def states_directions(path: Path) -> bool:
    """Return whether a NIfTI file states the directions of its axes, in a qform or an sform."""
    return any(code > 0 for code in _header(path)[1]["form_codes"])


def _header(path: Path) -> tuple[str, dict[str, tuple[Any, ...]]]:
    """Return the byte order of a header, for `struct`, and its fields."""
    header = b""
    with path.open("rb") as file:
        for piece in pieces(path, file, _compression(path)):
            header += piece[:VOXELS_FROM]
            if len(header) >= VOXELS_FROM:
                break
    if header[:4] in (struct.pack(f"{order}i", NIFTI_2_BYTES) for order in "<>"):
        raise VolumeError(f"{path}: the file is NIfTI-2, but NIfTI-1 is read: save it as NIfTI-1, as with nibabel")
    order = ">" if header[:4] == struct.pack(">i", HEADER_BYTES) else "<"
    if header[:4] != struct.pack(f"{order}i", HEADER_BYTES) or len(header) < VOXELS_FROM:
        raise VolumeError(f"{path}: the file does not begin with a NIfTI header")
    return order, {name: struct.unpack_from(order + code, header, at) for name, (code, at) in LAYOUT.items()}


def _compression(path: Path) -> int | None:
    return GZIP if path.suffix == ".gz" else None


def _check_spacings_agree(path: Path, spacing: Sequence[float], sform: Sequence[float]) -> None:
    """Raise `VolumeError` if the sform has another spacing than pixdim, which SimpleITK uses."""
    norms = np.linalg.norm(np.reshape(sform, (3, 4))[:, : len(spacing)], axis=0)
    if not np.allclose(norms, spacing, rtol=SPACING_TOLERANCE, atol=0.0):
        stated, other = (", ".join(f"{step:g}" for step in each) for each in (spacing, norms))
        raise VolumeError(
            f"{path}: the spacing is ({stated}) by pixdim, but ({other}) by the sform: correct one of them"
        )


def _check_forms_agree(path: Path, pixdim: Sequence[float], forms: Sequence[float]) -> None:
    """Raise `VolumeError` if qform and sform differ: SimpleITK uses only one of them.

    Args:
        path: The file.
        pixdim: Sign of the qform's third axis, then the spacing.
        forms: Quaternion (b, c, d) and offset of the qform, then the rows of the sform.
    """
    # Deferred: phantoms, and volumes in the cache, need no scipy.
    from scipy.spatial.transform import Rotation

    b, c, d, *offset = forms[:6]
    turned = Rotation.from_quat([b, c, d, math.sqrt(max(0.0, 1.0 - b * b - c * c - d * d))]).as_matrix()
    turned[:, 2] *= -1.0 if pixdim[0] < 0.0 else 1.0
    sform = np.reshape(forms[6:], (3, 4))
    cosines = sform[:, :3] / np.linalg.norm(sform[:, :3], axis=0)
    moved = np.linalg.norm(sform[:, 3] - offset) / min(pixdim[1:])
    if np.abs(cosines - turned).max() > COSINE_TOLERANCE:
        # Rounding may lead beyond -1 and 1.
        angle_deg = np.degrees(np.arccos(np.clip(np.sum(cosines * turned, axis=0), -1.0, 1.0))).max()
        stated = f"directions that differ by up to {angle_deg:.3g}° (each cosine may differ by {COSINE_TOLERANCE})"
    elif moved > ORIGIN_TOLERANCE:
        origins = (", ".join(f"{number:g}" for number in each) for each in (offset, sform[:, 3]))
        stated = (
            f"the origins ({') and ('.join(origins)}), which may differ by {ORIGIN_TOLERANCE} of the smallest spacing"
        )
    else:
        return
    raise VolumeError(f"{path}: qform and sform state {stated}: copy the right one over the other, as with fslorient")

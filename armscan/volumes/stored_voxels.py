"""Check that an image file stores exactly the voxels that its header declares, undamaged.

SimpleITK allocates the declared size before it looks at the file, and verifies neither checksum nor end of compressed
voxels. Here a file too small for its declared size is refused unread; compressed voxels are inflated in chunks, which
verifies their checksum, and never beyond the declared size.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from armscan.errors import VolumeError

PIECE_BYTES = 1 << 20
# More than any scanner produces.
MAX_VOXELS = 2**30
# The highest compression ratio of deflate.
MAX_RATIO = 1032
# `wbits` of zlib for each format; a MetaImage's header does not say which of the two it uses.
GZIP, GZIP_OR_ZLIB = 31, 47


@dataclass(frozen=True)
class StoredVoxels:
    """Location of voxels in a file.

    Args:
        file: File that holds the voxels.
        n_bytes: Number of uncompressed bytes that the header declares, including `n_before`.
        offset: Number of bytes in the file before the voxels, or before their compressed stream.
        compression: `GZIP` or `GZIP_OR_ZLIB`; None if the voxels are not compressed.
        n_before: Number of uncompressed bytes between the offset and the first voxel.
        finite: Data type of the voxels, such as '<f4', to check them for NaN and infinity; None: no check.
    """

    file: Path
    n_bytes: int
    offset: int = 0
    compression: int | None = None
    n_before: int = 0
    finite: str | None = None


def check_stored(path: Path, stored: StoredVoxels) -> None:
    """Raise `VolumeError`, naming the image `path`, unless the file stores exactly the declared voxels, undamaged."""
    n_stored = stored.file.stat().st_size - stored.offset
    if stored.compression is None:
        _check_length(path, n_stored, stored.n_bytes)
        if stored.finite is None:
            return
    elif n_stored * MAX_RATIO < stored.n_bytes:
        raise VolumeError(
            f"{path}: the file is truncated or damaged: it holds {max(0, n_stored)} compressed bytes of voxels, which "
            f"cannot be the {stored.n_bytes} that its header promises"
        )
    n_bytes, rest = 0, b""
    with stored.file.open("rb") as file:
        file.seek(stored.offset)
        for piece in pieces(path, file, stored.compression):
            first_voxel = max(0, stored.n_before - n_bytes)
            n_bytes += len(piece)
            if n_bytes > stored.n_bytes:
                break
            if stored.finite is not None:
                voxels = rest + piece[first_voxel:]
                n_whole = len(voxels) // np.dtype(stored.finite).itemsize
                if not np.isfinite(np.frombuffer(voxels, stored.finite, n_whole)).all():
                    raise VolumeError(f"{path}: holds a voxel that is NaN or infinite, but a labelmap holds numbers")
                rest = voxels[n_whole * np.dtype(stored.finite).itemsize :]
    _check_length(path, n_bytes, stored.n_bytes)


def pieces(path: Path, file: BinaryIO, compression: int | None) -> Iterator[bytes]:
    """Yield the rest of a file in chunks, inflated if it is compressed.

    Raises:
        VolumeError: If the compressed data is damaged or truncated; `path` is the image that the message names.
    """
    if compression is None:
        yield from iter(lambda: file.read(PIECE_BYTES), b"")
        return
    try:
        inflater, stored = zlib.decompressobj(compression), file.read(PIECE_BYTES)
        while stored:
            yield inflater.decompress(stored, PIECE_BYTES)
            stored = inflater.unconsumed_tail or inflater.unused_data or file.read(PIECE_BYTES)
            if inflater.eof and stored:
                # Some programs write several concatenated streams.
                inflater = zlib.decompressobj(compression)
    except zlib.error as error:
        raise VolumeError(f"{path}: the file is truncated or damaged ({error})") from error
    if not inflater.eof:
        raise VolumeError(f"{path}: the file is truncated: it ends within its compressed voxels")


def _check_length(path: Path, n_stored: int, n_promised: int) -> None:
    if n_stored != n_promised:
        more = f"more than {n_promised}" if n_stored > n_promised else str(max(0, n_stored))
        state = "truncated" if n_stored < n_promised else "damaged"
        raise VolumeError(
            f"{path}: the file is {state}: it holds {more} bytes of voxels, but its header promises {n_promised}"
        )


def count_voxels(path: Path, sizes: Sequence[int]) -> int:
    """Return how many voxels an image of these sizes has; raise `VolumeError` if it has none, or too many."""
    if min(sizes, default=0) < 1:
        raise VolumeError(f"{path}: the image has the size {tuple(sizes)}, but a labelmap must not be empty")
    # A few compressed bytes can expand beyond the memory.
    if (n_voxels := math.prod(sizes)) > MAX_VOXELS:
        raise VolumeError(f"{path}: the image has {n_voxels} voxels, but a labelmap has at most {MAX_VOXELS}")
    return n_voxels


def check_spacing(path: Path, spacing: Sequence[float]) -> None:
    """Raise `VolumeError` unless the spacing along each axis, in mm, is finite and above 0."""
    if not all(math.isfinite(step) and step > 0 for step in spacing):
        received = ", ".join(f"{step:g}" for step in spacing)
        raise VolumeError(f"{path}: the spacing in the file is ({received}) mm, but each must be finite and above 0")

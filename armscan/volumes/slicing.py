"""Compiled lookup of a slice: the nearest voxel at each point of a plane, without touching the rest of the volume."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.utils.arrays import FloatArray
from armscan.utils.compilation import cached_njit
from armscan.utils.prefetch import prefetch

# Rows that are read together, after voxels of the next rows were prefetched; pixels from one prefetch to the next.
N_ROWS, PREFETCH_STEP = 8, 8
# Columns of voxels along X, and along Y, in a block of `occupied_depths`.
BLOCK = 8
LARGEST_INT32 = 2**31 - 1
# In mm, far above the rounding errors of positions.
SMALLEST_CLEARANCE = 1e-12

# First position of a row of pixels on an axis, in voxels, and the step from one pixel to the next.
Line = tuple[float, float]
Lines = tuple[Line, Line, Line]
# For an axis of the volume: its part of the plane's X axis, the plane's origin and the spacing in mm, and the step.
Axis = tuple[float, float, float, float]


@cached_njit(nogil=True, error_model="numpy")
def occupied_depths(labels_yxz: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return the range of depths, first and after the last, that labels occupy in each block of 8 x 8 voxel columns.

    The result has the shape (ceil(nx / 8), ceil(ny / 8), 2). A block of background has the range (nz, 0).
    """
    n_y, n_x, n_z = labels_yxz.shape
    depths = np.empty((-(-n_x // BLOCK), -(-n_y // BLOCK), 2), dtype=np.int32)
    for i in range(depths.shape[0]):
        for j in range(depths.shape[1]):
            found = np.zeros(n_z, dtype=np.uint8)
            for x in range(BLOCK * i, min(n_x, BLOCK * i + BLOCK)):
                for y in range(BLOCK * j, min(n_y, BLOCK * j + BLOCK)):
                    column = labels_yxz[y, x]
                    for z in range(n_z):
                        found[z] |= column[z]
            occupied = np.flatnonzero(found)
            depths[i, j, 0] = occupied[0] if occupied.size else n_z
            depths[i, j, 1] = occupied[-1] + 1 if occupied.size else 0
    return depths


@cached_njit(nogil=True, error_model="numpy")
def sample_plane(
    labels_yxz: NDArray[np.uint8],
    occupied: NDArray[np.int32],
    spacing_mm: tuple[float, float, float],
    matrix: FloatArray,
    offset_mm: FloatArray,
    slice_xz: NDArray[np.uint8],
) -> None:
    """Fill a slice with the voxels nearest to its points.

    Pixel (i, k) is p = (i sx, 0, k sz) and takes the voxel floor(q / s + 0.5) of q = matrix p + offset, 0 outside.

    Args:
        labels_yxz: Labels of the volume, shape (ny, nx, nz), C-contiguous. Y comes first so that a slice across the arm
            lies in a small part of memory.
        occupied: `occupied_depths` of the labels; pixels outside them are 0, without a lookup.
        spacing_mm: Voxel spacing (sx, sy, sz) in mm.
        matrix: Linear map from the plane's frame into the volume's, shape (3, 3): a rotation, unless the volume is
            deformed.
        offset_mm: Origin of the plane in the volume, in mm, shape (3,).
        slice_xz: Slice to fill, indexed [across, depth], C-contiguous.
    """
    n_rows, n_depth = 2 * N_ROWS, slice_xz.shape[1]
    plane = occupied, spacing_mm, matrix, offset_mm
    # With indices half as wide, SIMD computes twice as many at a time.
    if labels_yxz.size <= LARGEST_INT32:
        _sample(labels_yxz, *plane, np.empty((n_rows, n_depth), dtype=np.int32), slice_xz)
    else:
        _sample(labels_yxz, *plane, np.empty((n_rows, n_depth), dtype=np.int64), slice_xz)


def clearance(
    spacing_mm: tuple[float, float, float],
    matrix: FloatArray,
    offset_mm: FloatArray,
    shape: tuple[int, int],
) -> float:
    """Return how far each entry of a plane's matrix and offset may be off without changing a pixel of its slice.

    Args:
        spacing_mm: Voxel spacing (sx, sy, sz) in mm.
        matrix: Rotation from the plane's frame into the volume's, shape (3, 3).
        offset_mm: Origin of the plane in the volume, in mm, shape (3,).
        shape: Number of pixels (across, depth).
    """
    across_mm, depth_mm = (np.arange(n) * step for n, step in zip(shape, (spacing_mm[0], spacing_mm[2]), strict=True))
    nearest = 0.5
    for row, offset, step in zip(matrix, offset_mm, spacing_mm, strict=True):
        positions = (row[0] * across_mm[:, None] + row[2] * depth_mm + offset) / step + 0.5
        nearest = min(nearest, float(np.abs(positions - np.rint(positions)).min()))
    # Halved as a margin for rounding; 0 if what is left is too close to rounding errors.
    free: float = nearest * min(spacing_mm) / (across_mm[-1] + depth_mm[-1] + 1.0) / 2.0
    return free if free > SMALLEST_CLEARANCE else 0.0


@cached_njit(nogil=True, error_model="numpy")
def _sample(
    labels_yxz: NDArray[np.uint8],
    occupied: NDArray[np.int32],
    spacing_mm: tuple[float, float, float],
    matrix: FloatArray,
    offset_mm: FloatArray,
    indices: NDArray[Any],
    slice_xz: NDArray[np.uint8],
) -> None:
    """Do the work of `sample_plane`; `indices` is a buffer for the flat voxel indices of the rows in progress."""
    s_x, s_y, s_z = spacing_mm
    axes = (
        _axis(0, matrix, offset_mm, s_x, s_z),
        _axis(1, matrix, offset_mm, s_y, s_z),
        _axis(2, matrix, offset_mm, s_z, s_z),
    )
    n_across, n_depth = slice_xz.shape
    n_y, n_x, n_z = labels_yxz.shape
    voxels, shape = labels_yxz.ravel(), (n_x, n_y, n_z)
    pixels = slice_xz.ravel()
    for pixel in range(pixels.size):
        pixels[pixel] = 0
    inside = np.empty((2 * N_ROWS, 2), dtype=np.int64)
    along = np.arange(n_depth).astype(np.float64)
    # A slice's voxels are scattered over memory: the next rows' are prefetched before the previous rows' are read.
    for first in range(0, n_across + N_ROWS, N_ROWS):
        if first < n_across:
            ends = _lines(axes, first * s_x), _lines(axes, (min(first + N_ROWS, n_across) - 1) * s_x)
            start_all, stop_all = _within_occupied(ends, occupied, shape, n_depth)
            is_inside = _are_inside(ends, shape, start_all, stop_all)
            for i in range(first, min(first + N_ROWS, n_across)):
                slot = i % (2 * N_ROWS)
                inside[slot, 0], inside[slot, 1] = 0, 0
                if start_all >= stop_all:
                    continue
                lines, start, stop = _lines(axes, i * s_x), start_all, stop_all
                if not is_inside:
                    start, stop = _within(lines[0], 0, shape[0], start, stop)
                    start, stop = _within(lines[1], 0, shape[1], start, stop)
                    start, stop = _within(lines[2], 0, shape[2], start, stop)
                inside[slot, 0], inside[slot, 1] = start, stop
                row = indices[slot, start:stop]
                _find_indices(lines, shape, along[start:stop], row)
                for pixel in range(0, row.size, PREFETCH_STEP):
                    prefetch(voxels, np.uint64(row[pixel]))
        for i in range(max(0, first - N_ROWS), min(first, n_across)):
            start, stop = inside[i % (2 * N_ROWS)]
            _read(voxels, indices[i % (2 * N_ROWS), start:stop], slice_xz[i, start:stop])


@cached_njit(nogil=True, error_model="numpy")
def _axis(axis: int, matrix: FloatArray, offset_mm: FloatArray, spacing_mm: float, s_z: float) -> Axis:
    """Return what `_lines` needs of an axis with this spacing; pixels are `s_z` mm apart in depth."""
    return matrix[axis, 0], offset_mm[axis], spacing_mm, matrix[axis, 2] * s_z / spacing_mm


@cached_njit(nogil=True, error_model="numpy")
def _lines(axes: tuple[Axis, Axis, Axis], across_mm: float) -> Lines:
    """Return the line, on each axis, of the row of pixels that is `across_mm` across."""
    (m_x, b_x, s_x, step_x), (m_y, b_y, s_y, step_y), (m_z, b_z, s_z, step_z) = axes
    return (
        ((m_x * across_mm + b_x) / s_x + 0.5, step_x),
        ((m_y * across_mm + b_y) / s_y + 0.5, step_y),
        ((m_z * across_mm + b_z) / s_z + 0.5, step_z),
    )


@cached_njit(nogil=True, error_model="numpy")
def _within_occupied(
    ends: tuple[Lines, Lines], occupied: NDArray[np.int32], shape: tuple[int, int, int], n_depth: int
) -> tuple[int, int]:
    """Return pixels (start, stop) outside which a group of rows is empty; `ends` has its first and last lines."""
    lowest_x, highest_x = _blocks(ends[0][0], ends[1][0], shape[0], n_depth)
    lowest_y, highest_y = _blocks(ends[0][1], ends[1][1], shape[1], n_depth)
    lowest, highest = shape[2], 0
    for x in range(lowest_x, highest_x):
        for y in range(lowest_y, highest_y):
            lowest, highest = min(lowest, occupied[x, y, 0]), max(highest, occupied[x, y, 1])
    if lowest >= highest:
        return 0, 0
    # Rounding is monotonic: positions rise or fall from row to row, so the first and last row bound the others.
    start, stop = _within(ends[0][2], lowest, highest, 0, n_depth)
    start_last, stop_last = _within(ends[1][2], lowest, highest, 0, n_depth)
    return min(start, start_last), max(stop, stop_last)


@cached_njit(nogil=True, error_model="numpy")
def _blocks(first: Line, last: Line, n_voxels: int, n_depth: int) -> tuple[int, int]:
    """Return the range of blocks on an axis that the pixels of rows `first` to `last` lie in."""
    farthest = n_depth - 1
    lowest = min(min(first[0], first[0] + first[1] * farthest), min(last[0], last[0] + last[1] * farthest))
    highest = max(max(first[0], first[0] + first[1] * farthest), max(last[0], last[0] + last[1] * farthest))
    if highest < 0.0 or lowest >= n_voxels:
        return 0, 0
    return int(max(lowest, 0.0)) // BLOCK, int(min(highest, n_voxels - 1.0)) // BLOCK + 1


@cached_njit(nogil=True, error_model="numpy")
def _are_inside(ends: tuple[Lines, Lines], shape: tuple[int, int, int], start: int, stop: int) -> bool:
    """Return whether pixels [start, stop) of all rows lie in the volume: whether those at the ends do."""
    for lines in ends:
        for axis in range(3):
            first, step = lines[axis]
            if not 0.0 <= first + step * start < shape[axis] or not 0.0 <= first + step * (stop - 1) < shape[axis]:
                return False
    return True


@cached_njit(nogil=True, error_model="numpy")
def _find_indices(lines: Lines, shape: tuple[int, int, int], along: FloatArray, indices: NDArray[Any]) -> None:
    """Fill the flat voxel indices of a row's pixels, whose numbers are `along`."""
    (first_x, step_x), (first_y, step_y), (first_z, step_z) = lines
    n_x, n_z = float(shape[0]), float(shape[2])
    # In floats, which hold these whole numbers exactly, so that SIMD computes several at a time.
    for k in range(indices.size):
        x, y = np.floor(first_x + step_x * along[k]), np.floor(first_y + step_y * along[k])
        indices[k] = (y * n_x + x) * n_z + np.floor(first_z + step_z * along[k])


@cached_njit(nogil=True, error_model="numpy")
def _read(voxels: NDArray[np.uint8], indices: NDArray[Any], row: NDArray[np.uint8]) -> None:
    """Fill part of a slice's row."""
    for k in range(indices.size):
        # An unsigned index needs no check for negative values.
        row[k] = voxels[np.uint64(indices[k])]


@cached_njit(nogil=True, error_model="numpy")
def _within(line: Line, lowest: int, highest: int, start: int, stop: int) -> tuple[int, int]:
    """Return the range of pixels within [start, stop) that lie in voxels [lowest, highest)."""
    first, step = line
    # Rounding is monotonic: positions rise or fall along a row, so its ends bound the rest.
    if lowest <= first + step * start < highest and lowest <= first + step * (stop - 1) < highest:
        return start, stop
    enters, leaves = (float(lowest), float(highest)) if step >= 0.0 else (float(highest), float(lowest))
    start = _first_beyond(line, enters, start, stop)
    return start, _first_beyond(line, leaves, start, stop)


@cached_njit(nogil=True, error_model="numpy")
def _first_beyond(line: Line, limit: float, start: int, stop: int) -> int:
    """Return the first pixel past a limit: at or above it if positions rise, below it if they fall; else `stop`."""
    first, step = line
    while start < stop:
        middle = (start + stop) // 2
        if (first + step * middle >= limit) == (step >= 0.0):
            stop = middle
        else:
            start = middle + 1
    return start

"""The compiled lookup of a slice: nearest voxel at each point of a plane, nothing else of the volume touched."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from armscan.utils.prefetch import prefetch

# Rows whose voxels are asked for before those of the first of them are read, and pixels between two that are asked for.
N_AHEAD, PREFETCH_STEP = 8, 8
LARGEST_INT32 = 2**31 - 1

# First position of a row of pixels on an axis, in voxels, and the step from one pixel to the next.
Line = tuple[float, float]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sample_plane(
    labels_xyz: NDArray[np.uint8],
    spacing_mm: tuple[float, float, float],
    matrix: NDArray[np.float64],
    offset_mm: NDArray[np.float64],
    slice_xz: NDArray[np.uint8],
) -> None:
    """Fill a slice with the voxels nearest to its points.

    Pixel (i, k) is p = (i sx, 0, k sz) and takes the voxel floor(q / s + 0.5) of q = matrix p + offset, 0 outside.

    Args:
        labels_xyz: Labels of the volume, C-contiguous.
        spacing_mm: Voxel spacing (sx, sy, sz) in mm.
        matrix: Rotation from the plane's frame into the volume's, shape (3, 3).
        offset_mm: Origin of the plane in the volume, in mm, shape (3,).
        slice_xz: Slice to fill, indexed [across, depth], C-contiguous.
    """
    n_rows, n_depth = N_AHEAD + 1, slice_xz.shape[1]
    # Of places half as wide, twice as many are computed at a time.
    if labels_xyz.size <= LARGEST_INT32:
        _sample(labels_xyz, spacing_mm, matrix, offset_mm, np.empty((n_rows, n_depth), dtype=np.int32), slice_xz)
    else:
        _sample(labels_xyz, spacing_mm, matrix, offset_mm, np.empty((n_rows, n_depth), dtype=np.int64), slice_xz)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sample(
    labels_xyz: NDArray[np.uint8],
    spacing_mm: tuple[float, float, float],
    matrix: NDArray[np.float64],
    offset_mm: NDArray[np.float64],
    places: NDArray[Any],
    slice_xz: NDArray[np.uint8],
) -> None:
    """As `sample_plane`; `places` is for the places, in the flat volume, of the voxels of the rows under way."""
    s_x, s_y, s_z = spacing_mm
    n_across, n_depth = slice_xz.shape
    voxels, n_rows = labels_xyz.ravel(), places.shape[0]
    inside = np.empty((n_rows, 2), dtype=np.int64)
    along = np.arange(n_depth).astype(np.float64)
    step_x, step_y, step_z = matrix[0, 2] * s_z / s_x, matrix[1, 2] * s_z / s_y, matrix[2, 2] * s_z / s_z
    # A slice lies scattered over the volume's memory: what it waits for is fetched while the next places are computed.
    for i in range(n_across + N_AHEAD):
        if i < n_across:
            across_mm = i * s_x
            lines = (
                ((matrix[0, 0] * across_mm + offset_mm[0]) / s_x + 0.5, step_x),
                ((matrix[1, 0] * across_mm + offset_mm[1]) / s_y + 0.5, step_y),
                ((matrix[2, 0] * across_mm + offset_mm[2]) / s_z + 0.5, step_z),
            )
            start, stop = _within(lines[0], labels_xyz.shape[0], 0, n_depth)
            start, stop = _within(lines[1], labels_xyz.shape[1], start, stop)
            start, stop = _within(lines[2], labels_xyz.shape[2], start, stop)
            inside[i % n_rows, 0], inside[i % n_rows, 1] = start, stop
            row = places[i % n_rows, start:stop]
            _find_places(lines, labels_xyz.shape, along[start:stop], row)
            for pixel in range(0, row.size, PREFETCH_STEP):
                prefetch(voxels, np.uint64(row[pixel]))
        if i >= N_AHEAD:
            read = i - N_AHEAD
            start, stop = inside[read % n_rows]
            _read(voxels, places[read % n_rows, start:stop], slice_xz[read], start)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _find_places(
    lines: tuple[Line, Line, Line], shape: tuple[int, int, int], along: NDArray[np.float64], places: NDArray[Any]
) -> None:
    """Fill the places of voxels, those of the pixels with the numbers `along` of a row."""
    (first_x, step_x), (first_y, step_y), (first_z, step_z) = lines
    n_y, n_z = float(shape[1]), float(shape[2])
    # In floats, which hold such whole numbers exactly, because several of them are computed at a time.
    for k in range(places.size):
        x, y = np.floor(first_x + step_x * along[k]), np.floor(first_y + step_y * along[k])
        places[k] = (x * n_y + y) * n_z + np.floor(first_z + step_z * along[k])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _read(voxels: NDArray[np.uint8], places: NDArray[Any], row: NDArray[np.uint8], start: int) -> None:
    """Fill a row of a slice: voxels from the pixel `start` on, background before and after them."""
    before, inside, after = row[:start], row[start : start + places.size], row[start + places.size :]
    for k in range(before.size):
        before[k] = 0
    for k in range(inside.size):
        # An index without a sign is not looked at for being negative.
        inside[k] = voxels[np.uint64(places[k])]
    for k in range(after.size):
        after[k] = 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _within(line: Line, n_voxels: int, start: int, stop: int) -> tuple[int, int]:
    """Return which of the pixels from `start` to before `stop` lie within an axis, as such a pair."""
    first, step = line
    # Rounding keeps an order, so that positions rise or fall all along a row, and its ends tell of all of it.
    if 0.0 <= first + step * start < n_voxels and 0.0 <= first + step * (stop - 1) < n_voxels:
        return start, stop
    enters, leaves = (0.0, float(n_voxels)) if step >= 0.0 else (float(n_voxels), 0.0)
    start = _first_beyond(line, enters, start, stop)
    return start, _first_beyond(line, leaves, start, stop)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _first_beyond(line: Line, limit: float, start: int, stop: int) -> int:
    """Return the first pixel that has passed a limit, from which on positions are at least it; `stop` if none has."""
    first, step = line
    while start < stop:
        middle = (start + stop) // 2
        if (first + step * middle >= limit) == (step >= 0.0):
            stop = middle
        else:
            start = middle + 1
    return start

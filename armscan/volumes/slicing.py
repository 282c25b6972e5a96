"""The compiled lookup of a slice: nearest voxel at each point of a plane, nothing else of the volume touched."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

# Pixels between two voxels that are fetched ahead.
TOUCH_STEP = 16
# Place in the volume that pixels beside it are looked up at, before they are set to background.
ANYWHERE = 0
LARGEST_INT32 = 2**31 - 1

# First position on an axis, in voxels, of a row of pixels, and the step from one pixel to the next.
Line = tuple[float, float]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sample_plane(
    labels_xyz: NDArray[np.uint8],
    spacing_mm: tuple[float, float, float],
    matrix: NDArray[np.float64],
    offset_mm: NDArray[np.float64],
    slice_xz: NDArray[np.uint8],
) -> int:
    """Fill a slice with the voxels nearest to its points.

    Pixel (i, k) is p = (i sx, 0, k sz) and takes the voxel floor(q / s + 0.5) of q = matrix p + offset, 0 outside.

    Args:
        labels_xyz: Labels of the volume, C-contiguous.
        spacing_mm: Voxel spacing (sx, sy, sz) in mm.
        matrix: Rotation from the plane's frame into the volume's, shape (3, 3).
        offset_mm: Origin of the plane in the volume, in mm, shape (3,).
        slice_xz: Slice to fill, indexed [across, depth], C-contiguous.

    Returns:
        Nothing of use: something that depends on every voxel fetched ahead, so that no compiler leaves them out.
    """
    # Half as wide numbers are computed twice as many at a time.
    if labels_xyz.size <= LARGEST_INT32:
        places = np.empty(slice_xz.shape, dtype=np.int32)
        return _look_up(labels_xyz, spacing_mm, matrix, offset_mm, places, slice_xz)
    wide_places = np.empty(slice_xz.shape, dtype=np.int64)
    return _look_up(labels_xyz, spacing_mm, matrix, offset_mm, wide_places, slice_xz)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_up(
    labels_xyz: NDArray[np.uint8],
    spacing_mm: tuple[float, float, float],
    matrix: NDArray[np.float64],
    offset_mm: NDArray[np.float64],
    places_xz: NDArray[Any],
    slice_xz: NDArray[np.uint8],
) -> int:
    """As `sample_plane`, with memory for the place of each pixel's voxel in the flat volume."""
    inside = _find_places(labels_xyz.shape, spacing_mm, matrix, offset_mm, places_xz)
    voxels, pixels, places = labels_xyz.ravel(), slice_xz.ravel(), places_xz.ravel()
    # A slice lies scattered over the volume's memory, and much of its cost is waiting for that. These reads do not
    # depend on one another, so that the processor waits for many of them at once; those below find their voxels near.
    # Indices without a sign are not taken from the end where they are negative.
    touched = 0
    for pixel in range(0, places.size, TOUCH_STEP):
        touched |= voxels[np.uint64(places[pixel])]
    for pixel in range(places.size):
        pixels[pixel] = voxels[np.uint64(places[pixel])]
    n_across, n_depth = slice_xz.shape
    for i in range(n_across):
        for k in range(inside[i, 0]):
            slice_xz[i, k] = 0
        for k in range(inside[i, 1], n_depth):
            slice_xz[i, k] = 0
    return touched


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _find_places(
    shape: tuple[int, int, int],
    spacing_mm: tuple[float, float, float],
    matrix: NDArray[np.float64],
    offset_mm: NDArray[np.float64],
    places_xz: NDArray[Any],
) -> NDArray[np.int64]:
    """Fill the place of each pixel's voxel, `ANYWHERE` where it has none.

    Returns:
        The first pixel of each row that has a voxel, and the one after the last, shape (across, 2).
    """
    n_across, n_depth = places_xz.shape
    n_y, n_z = float(shape[1]), float(shape[2])
    s_x, s_y, s_z = spacing_mm
    inside = np.empty((n_across, 2), dtype=np.int64)
    steps = np.arange(n_depth).astype(np.float64)
    step_x, step_y, step_z = matrix[0, 2] * s_z / s_x, matrix[1, 2] * s_z / s_y, matrix[2, 2] * s_z / s_z
    for i in range(n_across):
        across_mm = i * s_x
        first_x = (matrix[0, 0] * across_mm + offset_mm[0]) / s_x + 0.5
        first_y = (matrix[1, 0] * across_mm + offset_mm[1]) / s_y + 0.5
        first_z = (matrix[2, 0] * across_mm + offset_mm[2]) / s_z + 0.5
        start, stop = _within((first_x, step_x), shape[0], 0, n_depth)
        start, stop = _within((first_y, step_y), shape[1], start, stop)
        start, stop = _within((first_z, step_z), shape[2], start, stop)
        inside[i] = start, stop
        for k in range(start):
            places_xz[i, k] = ANYWHERE
        for k in range(stop, n_depth):
            places_xz[i, k] = ANYWHERE
        # From 0 on, in floats, which hold whole numbers exactly: so several are computed at a time.
        places, along = places_xz[i, start:stop], steps[start:stop]
        for k in range(places.size):
            x, y = np.floor(first_x + step_x * along[k]), np.floor(first_y + step_y * along[k])
            places[k] = (x * n_y + y) * n_z + np.floor(first_z + step_z * along[k])
    return inside


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _within(line: Line, n: int, start: int, stop: int) -> tuple[int, int]:
    """Return which of the pixels from `start` to `stop` lie within the `n` voxels of an axis: those from .. to .."""
    first, step = line
    # Rounding keeps an order, so that positions rise or fall all along a row: its ends tell.
    if 0.0 <= first + step * start < n and 0.0 <= first + step * (stop - 1) < n:
        return start, stop
    enters, leaves = (0.0, n) if step >= 0.0 else (n, 0.0)
    start = _first_beyond(line, enters, start, stop)
    return start, _first_beyond(line, leaves, start, stop)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _first_beyond(line: Line, limit: float, start: int, stop: int) -> int:
    """Return the first pixel whose position has passed a limit, which itself is on the upper side; `stop` if none."""
    first, step = line
    while start < stop:
        middle = (start + stop) // 2
        if (first + step * middle >= limit) == (step >= 0.0):
            stop = middle
        else:
            start = middle + 1
    return start

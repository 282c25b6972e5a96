"""The compiled lookup of a slice: nearest voxel at each point of a plane, nothing else of the volume touched."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

# Pixels between two voxels of a row that are fetched ahead.
TOUCH_STEP = 8


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _touch_voxels(
    voxels: NDArray[np.uint8],
    shape: tuple[int, int, int],
    first: tuple[float, float, float],
    row_step: tuple[float, float, float],
    pixel_step: tuple[float, float, float],
    slice_shape: tuple[int, int],
) -> int:
    """Reads every eighth voxel of a slice, all rows in a run.

    A slice lies scattered over the volume's memory. Row by row, the processor would wait for each row's voxels anew;
    these reads do not depend on one another, so that it waits for many of them at once, and finds them near later.

    Args:
        voxels: the volume's labels, flat.
        shape: of the volume.
        first: where the first pixel lies, in voxels.
        row_step: from one row to the next, in voxels.
        pixel_step: from one pixel of a row to the next, in voxels.
        slice_shape: (across, depth).

    Returns:
        Something that depends on each of them, so that no compiler leaves out the reads.
    """
    n_x, n_y, n_z = shape
    touched = 0
    for i in range(slice_shape[0]):
        for k in range(0, slice_shape[1], TOUCH_STEP):
            x = min(max(first[0] + row_step[0] * i + pixel_step[0] * k, 0.0), n_x - 1.0)
            y = min(max(first[1] + row_step[1] * i + pixel_step[1] * k, 0.0), n_y - 1.0)
            z = min(max(first[2] + row_step[2] * i + pixel_step[2] * k, 0.0), n_z - 1.0)
            touched |= voxels[(np.int64(x) * n_y + np.int64(y)) * n_z + np.int64(z)]
    return touched


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sample_plane(
    labels_xyz: NDArray[np.uint8],
    spacing_mm: tuple[float, float, float],
    matrix: NDArray[np.float64],
    offset_mm: NDArray[np.float64],
    slice_xz: NDArray[np.uint8],
) -> int:
    """Fills a slice with the voxels nearest to its points.

    Pixel (i, k) is p = (i sx, 0, k sz) and takes the voxel floor(q / s + 0.5) of q = matrix p + offset, 0 outside.

    Args:
        labels_xyz: the volume's labels, C-contiguous.
        spacing_mm: (sx, sy, sz).
        matrix: 3 x 3, from the plane's frame into the volume's.
        offset_mm: the plane's origin in the volume, shape (3,).
        slice_xz: the slice to fill, indexed [across, depth].

    Returns:
        Nothing of use; see `_touch_voxels`.
    """
    n_x, n_y, n_z = labels_xyz.shape
    s_x, s_y, s_z = spacing_mm
    n_across, n_depth = slice_xz.shape
    voxels = labels_xyz.ravel()
    places = np.empty(n_depth, dtype=np.int64)
    # In voxels: where the first pixel lies, and the way to the next row and to the next pixel of a row.
    first = (offset_mm[0] / s_x + 0.5, offset_mm[1] / s_y + 0.5, offset_mm[2] / s_z + 0.5)
    row_step = (matrix[0, 0] * s_x / s_x, matrix[1, 0] * s_x / s_y, matrix[2, 0] * s_x / s_z)
    step_x, step_y, step_z = matrix[0, 2] * s_z / s_x, matrix[1, 2] * s_z / s_y, matrix[2, 2] * s_z / s_z
    touched = _touch_voxels(voxels, (n_x, n_y, n_z), first, row_step, (step_x, step_y, step_z), slice_xz.shape)
    for i in range(n_across):
        across_mm = i * s_x
        first_x = (matrix[0, 0] * across_mm + offset_mm[0]) / s_x + 0.5
        first_y = (matrix[1, 0] * across_mm + offset_mm[1]) / s_y + 0.5
        first_z = (matrix[2, 0] * across_mm + offset_mm[2]) / s_z + 0.5
        # Where to look is computed apart from looking there, so that the first loop runs several pixels at a time.
        for k in range(n_depth):
            x = np.floor(first_x + step_x * k)
            y = np.floor(first_y + step_y * k)
            z = np.floor(first_z + step_z * k)
            # Compared as floats: a far-away plane must not overflow an integer.
            is_inside = (x >= 0.0) & (x < n_x) & (y >= 0.0) & (y < n_y) & (z >= 0.0) & (z < n_z)
            places[k] = np.int64((x * n_y + y) * n_z + z) if is_inside else np.int64(-1)
        for k in range(n_depth):
            slice_xz[i, k] = voxels[places[k]] if places[k] >= 0 else np.uint8(0)
    return touched

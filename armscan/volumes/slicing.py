"""The compiled lookup of a slice: nearest voxel at each point of a plane, nothing else of the volume touched."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

# Pixels between two voxels that are fetched ahead.
TOUCH_STEP = 8
# Any negative place is beside the volume.
OUTSIDE = -1


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
    voxels, pixels = labels_xyz.ravel(), slice_xz.ravel()
    places = _voxel_places(labels_xyz.shape, spacing_mm, matrix, offset_mm, slice_xz.shape)
    # A slice lies scattered over the volume's memory, and most of its cost is waiting for that. These reads do not
    # depend on one another, so that the processor waits for many of them at once; those below find their voxels near.
    touched = 0
    for pixel in range(0, places.size, TOUCH_STEP):
        touched |= voxels[max(places[pixel], 0)]
    for pixel in range(places.size):
        pixels[pixel] = voxels[places[pixel]] if places[pixel] >= 0 else np.uint8(0)
    return touched


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _voxel_places(
    shape: tuple[int, int, int],
    spacing_mm: tuple[float, float, float],
    matrix: NDArray[np.float64],
    offset_mm: NDArray[np.float64],
    slice_shape: tuple[int, int],
) -> NDArray[np.int64]:
    """Return for each pixel, in order, the place of its voxel in the flat volume, `OUTSIDE` where there is none."""
    n_x, n_y, n_z = shape
    s_x, s_y, s_z = spacing_mm
    n_across, n_depth = slice_shape
    places = np.empty((n_across, n_depth), dtype=np.int64)
    # Voxels from one pixel of a row to the next.
    step_x, step_y, step_z = matrix[0, 2] * s_z / s_x, matrix[1, 2] * s_z / s_y, matrix[2, 2] * s_z / s_z
    for i in range(n_across):
        across_mm = i * s_x
        first_x = (matrix[0, 0] * across_mm + offset_mm[0]) / s_x + 0.5
        first_y = (matrix[1, 0] * across_mm + offset_mm[1]) / s_y + 0.5
        first_z = (matrix[2, 0] * across_mm + offset_mm[2]) / s_z + 0.5
        row = places[i]
        for k in range(n_depth):
            x = np.floor(first_x + step_x * k)
            y = np.floor(first_y + step_y * k)
            z = np.floor(first_z + step_z * k)
            # Compared as floats: a far-away plane must not overflow an integer.
            is_inside = (x >= 0.0) & (x < n_x) & (y >= 0.0) & (y < n_y) & (z >= 0.0) & (z < n_z)
            row[k] = np.int64((x * n_y + y) * n_z + z) if is_inside else np.int64(OUTSIDE)
    return places.ravel()

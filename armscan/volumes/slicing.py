"""The compiled lookup of a slice: nearest voxel at each point of a plane, nothing else of the volume touched."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sample_plane(
    labels_xyz: NDArray[np.uint8],
    spacing_mm: tuple[float, float, float],
    matrix: NDArray[np.float64],
    offset_mm: NDArray[np.float64],
    slice_xz: NDArray[np.uint8],
) -> None:
    """Fills a slice with the voxels nearest to its points.

    Pixel (i, k) is p = (i sx, 0, k sz) and takes the voxel floor(q / s + 0.5) of q = matrix p + offset, 0 outside.

    Args:
        labels_xyz: the volume's labels, C-contiguous.
        spacing_mm: (sx, sy, sz).
        matrix: 3 x 3, from the plane's frame into the volume's.
        offset_mm: the plane's origin in the volume, shape (3,).
        slice_xz: the slice to fill, indexed [across, depth].
    """
    n_x, n_y, n_z = labels_xyz.shape
    s_x, s_y, s_z = spacing_mm
    n_across, n_depth = slice_xz.shape
    voxels = labels_xyz.ravel()
    places = np.empty(n_depth, dtype=np.int64)
    for i in range(n_across):
        across_mm = i * s_x
        row_x = matrix[0, 0] * across_mm
        row_y = matrix[1, 0] * across_mm
        row_z = matrix[2, 0] * across_mm
        # Where to look is computed apart from looking there, so that the first loop runs several pixels at a time.
        for k in range(n_depth):
            depth_mm = k * s_z
            x = np.floor((row_x + matrix[0, 2] * depth_mm + offset_mm[0]) / s_x + 0.5)
            y = np.floor((row_y + matrix[1, 2] * depth_mm + offset_mm[1]) / s_y + 0.5)
            z = np.floor((row_z + matrix[2, 2] * depth_mm + offset_mm[2]) / s_z + 0.5)
            # Compared as floats: a far-away plane must not overflow an integer.
            is_inside = (x >= 0.0) & (x < n_x) & (y >= 0.0) & (y < n_y) & (z >= 0.0) & (z < n_z)
            places[k] = np.int64((x * n_y + y) * n_z + z) if is_inside else np.int64(-1)
        for k in range(n_depth):
            slice_xz[i, k] = voxels[places[k]] if places[k] >= 0 else np.uint8(0)

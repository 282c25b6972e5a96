"""DBSCAN on a pixel grid, compiled: the same clusters as scikit-learn's, found from runs of pixels.

On a grid the neighbours within eps of a pixel fill a disc, so a neighbour count is a sum over the disc's rows (from
prefix sums), and the clusters are the connected components of core pixels. Core pixels are joined as runs: two runs in
rows d apart touch when the gap between them is at most the disc's half width at d.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True)
def disc_half_widths(eps_px: float) -> NDArray[np.int64]:
    """Returns for each row distance d = 0 .. floor(eps) the largest w with d^2 + w^2 <= eps^2."""
    widths = np.empty(int(np.floor(eps_px)) + 1, dtype=np.int64)
    for d in range(widths.size):
        width = int(np.floor(np.sqrt(eps_px * eps_px - d * d)))
        while d * d + (width + 1) * (width + 1) <= eps_px * eps_px:
            width += 1
        while d * d + width * width > eps_px * eps_px:
            width -= 1
        widths[d] = width
    return widths


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _find_core_pixels(mask: NDArray[np.bool_], widths: NDArray[np.int64], min_samples: int) -> NDArray[np.bool_]:
    """Marks the pixels of the mask with at least `min_samples` pixels (themselves included) in their disc."""
    n_rows, n_cols = mask.shape
    reach, pad = widths.size - 1, widths[0]
    # How many pixels of the mask lie before each column, with margins so that no disc leaves the table.
    before = np.zeros((n_rows + 2 * reach, n_cols + 2 * pad + 1), dtype=np.int32)
    for row in range(n_rows):
        line = before[row + reach]
        for col in range(n_cols):
            line[col + pad + 1] = line[col + pad] + mask[row, col]
        line[n_cols + pad + 1 :] = line[n_cols + pad]
    core = np.zeros((n_rows, n_cols), dtype=np.bool_)
    counts = np.empty(n_cols, dtype=np.int32)
    for row in range(n_rows):
        counts[:] = 0
        # Row by row of the disc, for all columns at once: such loops run several pixels at a time.
        for d in range(-reach, reach + 1):
            width = widths[abs(d)]
            line = before[row + reach + d]
            for col in range(n_cols):
                counts[col] += line[col + pad + width + 1] - line[col + pad - width]
        for col in range(n_cols):
            core[row, col] = mask[row, col] and counts[col] >= min_samples
    return core


@numba.njit(cache=True, nogil=True)
def _find_root(parents: NDArray[np.int64], run: int) -> int:
    while parents[run] != run:
        parents[run] = parents[parents[run]]
        run = parents[run]
    return run


@numba.njit(cache=True, nogil=True)
def _label_core_pixels(core: NDArray[np.bool_], widths: NDArray[np.int64], clusters: NDArray[np.int32]) -> int:
    """Writes the cluster number, from 1, of each core pixel into `clusters`; returns how many clusters there are."""
    n_rows, n_cols = core.shape
    first_run = np.zeros(n_rows + 1, dtype=np.int64)
    # Below an eps of 1 not even the next pixel is a neighbour, and every run is a single pixel.
    longest_run = n_cols if widths[0] >= 1 else 1
    capacity = n_rows * (n_cols // 2 + 1 if widths[0] >= 1 else n_cols)
    starts = np.empty(capacity, dtype=np.int64)
    stops = np.empty(capacity, dtype=np.int64)
    n_runs = 0
    for row in range(n_rows):
        col = 0
        while col < n_cols:
            if core[row, col]:
                starts[n_runs] = col
                while col < n_cols and core[row, col] and col - starts[n_runs] < longest_run:
                    col += 1
                stops[n_runs] = col - 1
                n_runs += 1
            else:
                col += 1
        first_run[row + 1] = n_runs
    parents = np.arange(n_runs)
    for row in range(n_rows):
        for run in range(first_run[row], first_run[row + 1]):
            for other_row in range(row, min(n_rows, row + widths.size)):
                width = widths[other_row - row]
                for other in range(max(run + 1, first_run[other_row]), first_run[other_row + 1]):
                    if starts[other] > stops[run] + width:
                        break
                    if stops[other] >= starts[run] - width:
                        a, b = _find_root(parents, run), _find_root(parents, other)
                        # The root is the earliest run, so roots come in the order of the clusters' first core pixels.
                        parents[max(a, b)] = min(a, b)
    numbers = np.zeros(n_runs, dtype=np.int32)
    n_clusters = 0
    for row in range(n_rows):
        for run in range(first_run[row], first_run[row + 1]):
            root = _find_root(parents, run)
            if root == run:
                n_clusters += 1
                numbers[run] = n_clusters
            clusters[row, starts[run] : stops[run] + 1] = numbers[root]
    return n_clusters


@numba.njit(cache=True, nogil=True)
def _lowest_core_cluster_near(
    clusters: NDArray[np.int32], core: NDArray[np.bool_], widths: NDArray[np.int64], row: int, col: int
) -> int:
    """Returns the lowest number among the core pixels in the disc about a pixel, 0 if there is none."""
    n_rows, n_cols = core.shape
    lowest = 0
    reach = widths.size - 1
    for other_row in range(max(0, row - reach), min(n_rows, row + reach + 1)):
        width = widths[abs(other_row - row)]
        for other_col in range(max(0, col - width), min(n_cols, col + width + 1)):
            if core[other_row, other_col]:
                number = clusters[other_row, other_col]
                if lowest == 0 or number < lowest:
                    lowest = number
    return lowest


@numba.njit(cache=True, nogil=True)
def _bounding_box(slice_xz: NDArray[np.uint8], label: int) -> tuple[int, int, int, int]:
    """Returns first row, row after the last, first column and column after the last of a label; all 0 without it."""
    n_rows, n_cols = slice_xz.shape
    row_first, row_stop, col_first, col_stop = n_rows, 0, n_cols, 0
    for row in range(n_rows):
        for col in range(n_cols):
            if slice_xz[row, col] == label:
                row_first = min(row_first, row)
                row_stop = row + 1
                col_first = min(col_first, col)
                col_stop = max(col_stop, col + 1)
    if row_stop == 0:
        return 0, 0, 0, 0
    return row_first, row_stop, col_first, col_stop


@numba.njit(cache=True, nogil=True)
def cluster_label(
    slice_xz: NDArray[np.uint8], label: int, eps_px: float, min_samples: int
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int64]]:
    """Clusters the pixels of a label as scikit-learn's DBSCAN does their coordinates in row-major order.

    Args:
        slice_xz: labels, indexed [across, depth].
        label: whose pixels.
        eps_px: largest distance of neighbours, in pixels.
        min_samples: neighbours, the pixel itself included, that make a core pixel.

    Returns:
        The cluster image (numbered from 1 in the order of the clusters' first core pixels; a border pixel belongs to
        the lowest-numbered cluster within eps; 0 for noise and background), the mean pixel coordinate of each
        cluster, shape (n_clusters, 2), and its number of pixels, shape (n_clusters,).
    """
    image = np.zeros(slice_xz.shape, dtype=np.int32)
    row_first, row_stop, col_first, col_stop = _bounding_box(slice_xz, label)
    mask = slice_xz[row_first:row_stop, col_first:col_stop] == label
    clusters = image[row_first:row_stop, col_first:col_stop]
    widths = disc_half_widths(eps_px)
    core = _find_core_pixels(mask, widths, min_samples)
    n_clusters = _label_core_pixels(core, widths, clusters)
    centres = np.zeros((n_clusters, 2))
    sizes = np.zeros(n_clusters, dtype=np.int64)
    if n_clusters == 0:
        return image, centres, sizes
    for row in range(mask.shape[0]):
        for col in range(mask.shape[1]):
            if not mask[row, col]:
                continue
            number = clusters[row, col]
            if number == 0:
                number = _lowest_core_cluster_near(clusters, core, widths, row, col)
                # Not a core pixel, so that its number misleads no later border pixel.
                clusters[row, col] = number
            if number > 0:
                centres[number - 1, 0] += row_first + row
                centres[number - 1, 1] += col_first + col
                sizes[number - 1] += 1
    for number in range(n_clusters):
        centres[number] /= sizes[number]
    return image, centres, sizes

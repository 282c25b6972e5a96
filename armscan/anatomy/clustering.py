"""DBSCAN on a pixel grid, compiled: the same clusters as scikit-learn's.

On a grid the neighbours within eps of a pixel fill a disc (an ellipse where pixels are not square), so neighbour counts
are sums over the disc's rows, and the clusters are the connected components of core pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.anatomy.connected_components import WORD, IntArray, Pixels, RunArray, Runs, find_runs, number_runs
from armscan.utils.compilation import cached_njit


def disc_half_widths(eps: float, row_step: float = 1.0, col_step: float = 1.0) -> IntArray:
    """Return for each row distance d = 0, 1, .. the largest w with (d row_step)^2 + (w col_step)^2 <= eps^2.

    Args:
        eps: Radius, in the unit of the steps.
        row_step: Distance between neighbouring rows. Default: 1.
        col_step: Distance between neighbouring columns. Default: 1.
    """
    rows, columns = np.arange(int(eps / row_step) + 2), np.arange(int(eps / col_step) + 2)
    with np.errstate(over="ignore"):
        is_inside = (rows[:, None] * row_step) ** 2 + (columns * col_step) ** 2 <= eps * eps
    n_inside: IntArray = is_inside.sum(axis=1)
    return n_inside[n_inside > 0] - 1


@cached_njit(nogil=True)
def count_disc_pixels(half_widths: IntArray) -> int:
    """Return the number of pixels in a disc, its centre included."""
    return int(2 * np.sum(2 * half_widths + 1) - (2 * half_widths[0] + 1))


@cached_njit(nogil=True, error_model="numpy")
def _find_core(mask: Pixels, stride: int, margin: int, half_widths: IntArray, min_samples: int, zero: Any) -> Pixels:
    """Return 0 or 1 for each pixel of a flat mask without its margins: whether it is a core pixel.

    The mask has rows of length `stride`, with margins of at least the disc's half width in columns and its half height
    in rows, so that no disc leaves it. `zero` is of the smallest type that holds the disc's number of pixels: SIMD sums
    more of a small type at a time.
    """
    pad, reach = half_widths[0], half_widths.size - 1
    first = reach * stride + margin
    n_pixels = mask.size - 2 * first
    inside = mask[first : first + n_pixels]
    window = np.full(n_pixels, zero)
    # A loop, because Numba takes two seconds longer to compile an assignment to a slice: for its shape error's text.
    for i in range(n_pixels):
        window[i] = inside[i]
    counts = np.full(n_pixels + 2 * reach * stride, zero)
    for width in range(pad + 1):
        if width > 0:
            left, right = mask[first - width :][:n_pixels], mask[first + width :][:n_pixels]
            for i in range(n_pixels):
                window[i] += left[i] + right[i]
        for d in range(-reach, reach + 1):
            if half_widths[abs(d)] == width:
                shifted = counts[(reach + d) * stride :][:n_pixels]
                for i in range(n_pixels):
                    shifted[i] += window[i]
    core = np.zeros(n_pixels, dtype=np.uint8)
    if min_samples <= count_disc_pixels(half_widths):
        # Of the counts' type, or the comparison would widen all of them.
        fewest, of_pixels = type(zero)(min_samples), counts[reach * stride :]
        for i in range(n_pixels):
            core[i] = inside[i] & np.uint8(of_pixels[i] >= fewest)
    return core


@cached_njit(nogil=True, error_model="numpy")
def _reached(shape: tuple[int, int], runs: Runs, numbers: RunArray, half_widths: IntArray, n_clusters: int) -> RunArray:
    """Return for each pixel the lowest cluster with a core pixel within eps, `n_clusters` where there is none."""
    (n_rows, n_cols), (starts, stops, first_run) = shape, runs
    reached = np.full(shape, np.int32(n_clusters))
    reach = half_widths.size - 1
    for row in range(n_rows):
        for run in range(first_run[row], first_run[row + 1]):
            number, start, stop = numbers[run], starts[run], stops[run] + 1
            for other_row in range(max(0, row - reach), min(n_rows, row + reach + 1)):
                width = half_widths[abs(other_row - row)]
                line = reached[other_row, max(0, start - width) : min(n_cols, stop + width)]
                for col in range(line.size):
                    line[col] = min(line[col], number)
    return reached


@cached_njit(nogil=True, error_model="numpy")
def bounding_boxes(slice_xz: Pixels, labels: IntArray) -> IntArray:
    """Return for each label its first row, row after the last, first column and column after the last, shape (n, 4).

    All four are 0 for a label that the slice lacks. There may be at most eight labels: each has one bit of a byte, so
    that SIMD combines many pixels at a time.
    """
    n_rows, n_cols = slice_xz.shape
    pixels = slice_xz.ravel()
    found = np.zeros(pixels.size, dtype=np.uint8)
    for i in range(labels.size):
        label, bit = np.uint8(labels[i]), np.uint8(1 << i)
        for pixel in range(pixels.size):
            found[pixel] |= bit * np.uint8(pixels[pixel] == label)
    in_rows, in_cols = np.zeros(n_rows, dtype=np.uint8), np.zeros(n_cols, dtype=np.uint8)
    for row in range(n_rows):
        line, in_row = found[n_cols * row :][:n_cols], np.uint8(0)
        for col in range(n_cols):
            in_row |= line[col]
            in_cols[col] |= line[col]
        in_rows[row] = in_row
    boxes = np.empty((labels.size, 4), dtype=np.int64)
    for i in range(labels.size):
        boxes[i, 0], boxes[i, 1] = _ends(in_rows, np.uint8(1 << i))
        boxes[i, 2], boxes[i, 3] = _ends(in_cols, np.uint8(1 << i))
    return boxes


@cached_njit(nogil=True, error_model="numpy")
def _ends(found: Pixels, bit: np.uint8) -> tuple[int, int]:
    """Return the first index with the bit and the index after the last one; 0 and 0 if there is none."""
    first, stop = 0, found.size
    while first < stop and not found[first] & bit:
        first += 1
    if first == stop:
        return 0, 0
    while not found[stop - 1] & bit:
        stop -= 1
    return first, stop


@cached_njit(nogil=True, error_model="numpy")
def _cluster(
    slice_xz: Pixels, label: int, box: IntArray, half_widths: IntArray, min_samples: int
) -> tuple[Pixels, RunArray, IntArray]:
    """Cluster a label's pixels, all of which lie in the box.

    Returns:
        The label's mask and the cluster of each pixel, both over the box; and for each cluster, noise last, the number
        of its pixels and the sums of their rows and columns, shape (n_clusters + 1, 3).
    """
    row_first, row_stop, col_first, col_stop = box
    n_rows, n_cols = row_stop - row_first, col_stop - col_first
    pad, reach = half_widths[0], half_widths.size - 1
    # Adjacent rows share a margin. Rows and the margin before them are whole words, so that empty words can be skipped.
    stride, margin = (n_cols + pad + WORD - 1) // WORD * WORD, (pad + WORD - 1) // WORD * WORD
    flat = np.zeros((n_rows + 2 * reach) * stride + 2 * margin, dtype=np.uint8)
    mask = flat[reach * stride + margin :][: n_rows * stride].reshape((n_rows, stride))
    wanted = np.uint8(label)
    for row in range(n_rows):
        labels, line = slice_xz[row_first + row, col_first : col_first + n_cols], mask[row, :n_cols]
        for col in range(n_cols):
            line[col] = labels[col] == wanted
    if count_disc_pixels(half_widths) < 2**8:
        flat_core = _find_core(flat, stride, margin, half_widths, min_samples, np.uint8(0))
    else:
        flat_core = _find_core(flat, stride, margin, half_widths, min_samples, np.uint32(0))
    core = flat_core.reshape((n_rows, stride))
    # With an eps below one column not even adjacent pixels are neighbours, and every run is a single pixel.
    runs = find_runs(core, n_cols, pad >= 1)
    numbers, n_clusters = number_runs(runs, half_widths)
    clusters = _reached((n_rows, n_cols), runs, numbers, half_widths, n_clusters)
    sums = np.zeros((n_clusters + 1, 3), dtype=np.int64)
    words = mask.view(np.uint64)
    for row in range(n_rows):
        words_of_row, line, numbers_of_row = words[row], mask[row], clusters[row]
        for word in range(words_of_row.size):
            if words_of_row[word] == 0:
                continue
            for col in range(WORD * word, WORD * word + WORD):
                if line[col]:
                    of_cluster = sums[numbers_of_row[col]]
                    of_cluster[0] += 1
                    of_cluster[1] += row_first + row
                    of_cluster[2] += col_first + col
    return mask[:, :n_cols], clusters, sums


def cluster_label(
    slice_xz: Pixels, label: int, half_widths: IntArray, min_samples: int
) -> tuple[NDArray[np.int32], NDArray[np.float64], IntArray]:
    """Cluster the pixels of a label as scikit-learn's DBSCAN does with their coordinates in row-major order.

    Args:
        slice_xz: Labels of the slice, indexed [across, depth].
        label: Label to cluster.
        half_widths: Half widths of the disc of neighbours, in pixels, as `disc_half_widths` returns them.
        min_samples: Number of neighbours, the pixel itself included, that make a core pixel.

    Returns:
        The cluster image (numbered from 1 in the order of the clusters' first core pixels; a border pixel belongs to
        the lowest-numbered cluster within eps; 0 for noise and background), the mean pixel coordinate of each
        cluster, shape (n_clusters, 2), and its number of pixels, shape (n_clusters,).
    """
    # A binary mask: slices that are not of the volumes' type may hold any integer labels.
    is_label = np.ascontiguousarray(slice_xz == label).view(np.uint8)
    (box,) = bounding_boxes(is_label, np.array([1]))
    mask, clusters, sums = _cluster(is_label, 1, box, half_widths, min_samples)
    first_row, _, first_col, _ = box
    sums = sums[:-1]
    image = np.zeros(slice_xz.shape, dtype=np.int32)
    box = image[first_row:, first_col:][: mask.shape[0], : mask.shape[1]]
    box[:] = np.where((mask > 0) & (clusters < len(sums)), clusters + 1, 0)
    return image, sums[:, 1:] / sums[:, :1], sums[:, 0].copy()


@cached_njit(nogil=True, error_model="numpy")
def summarise_label(
    slice_xz: Pixels,
    label: int,
    box: IntArray,
    half_widths: IntArray,
    min_samples: int,
    summary: NDArray[np.float64],
) -> None:
    """Cluster the pixels of a label, and keep only the summary that rewards and observations require.

    Args:
        slice_xz: Labels of the slice, indexed [across, depth].
        label: Label to cluster.
        box: Box around its pixels, a row of `bounding_boxes`.
        half_widths: Half widths of the disc of neighbours, in pixels; see `cluster_label`.
        min_samples: Number of neighbours that make a core pixel; see `cluster_label`.
        summary: Array to fill, shape (4,): number of clusters, number of their pixels, and mean of their centres,
            (across, depth) in pixels, 0 if there are none.
    """
    sums = _cluster(slice_xz, label, box, half_widths, min_samples)[2][:-1]
    summary[:] = 0.0
    summary[0] = len(sums)
    for of_cluster in sums:
        summary[1] += of_cluster[0]
        summary[2] += of_cluster[1] / of_cluster[0]
        summary[3] += of_cluster[2] / of_cluster[0]
    summary[2] /= max(1, len(sums))
    summary[3] /= max(1, len(sums))

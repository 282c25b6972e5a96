"""Compiled connected components of pixels that touch over a distance: runs of pixels in a union-find forest.

Two runs in rows d apart touch when the gap between them is at most the disc's half width at d.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armscan.utils.compilation import cached_njit

IntArray = NDArray[np.int64]
RunArray = NDArray[np.int32]
# First and last column of each run, and the number of the first run of each row.
Runs = tuple[RunArray, RunArray, IntArray]
Pixels = NDArray[np.uint8]
# Pixels that are skipped together if all are background: the bytes of a 64-bit integer.
WORD = 8


@cached_njit(nogil=True, error_model="numpy")
def find_runs(image: Pixels, n_cols: int, are_joined: bool) -> Runs:
    """Return the runs of pixels in a binary image; if neighbours in a row are not joined, each pixel is a run.

    Args:
        image: 0 or 1 for each pixel; the length of a row is a multiple of 8.
        n_cols: Number of columns that may hold a 1.
        are_joined: Whether neighbours in a row touch.
    """
    n_rows = image.shape[0]
    capacity = n_rows * (n_cols // 2 + 1 if are_joined else n_cols)
    starts, stops = np.empty(capacity, dtype=np.int32), np.empty(capacity, dtype=np.int32)
    first_run = np.zeros(n_rows + 1, dtype=np.int64)
    n_runs = 0
    words = image.view(np.uint64)
    for row in range(n_rows):
        line = image[row]
        for word in range(words.shape[1]):
            if words[row, word] == 0:
                continue
            for col in range(WORD * word, WORD * word + WORD):
                if line[col]:
                    if not are_joined or col == 0 or not line[col - 1]:
                        starts[n_runs] = col
                        n_runs += 1
                    stops[n_runs - 1] = col
        first_run[row + 1] = n_runs
    return starts[:n_runs], stops[:n_runs], first_run


@cached_njit(nogil=True)
def _find_root(parents: IntArray, run: int) -> int:
    while parents[run] != run:
        parents[run] = parents[parents[run]]
        run = parents[run]
    return run


@cached_njit(nogil=True, error_model="numpy")
def number_runs(runs: Runs, half_widths: IntArray) -> tuple[RunArray, int]:
    """Return the component of each run, from 0 in the order of their first runs, and how many there are."""
    starts, stops, first_run = runs
    n_rows, n_runs = first_run.size - 1, starts.size
    parents = np.arange(n_runs)
    for row in range(n_rows):
        for run in range(first_run[row], first_run[row + 1]):
            for other_row in range(row, min(n_rows, row + half_widths.size)):
                width = half_widths[other_row - row]
                for other in range(max(run + 1, first_run[other_row]), first_run[other_row + 1]):
                    if starts[other] > stops[run] + width:
                        break
                    if stops[other] >= starts[run] - width:
                        a, b = _find_root(parents, run), _find_root(parents, other)
                        # The root is the earliest run, so roots come in the order of the components' first pixels.
                        parents[max(a, b)] = min(a, b)
    numbers = np.empty(n_runs, dtype=np.int32)
    n_components = 0
    for run in range(n_runs):
        if parents[run] == run:
            numbers[run] = n_components
            n_components += 1
        else:
            numbers[run] = numbers[parents[run]]
    return numbers, n_components

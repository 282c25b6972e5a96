"""The slice as an image of fixed size in millimetres: the same for volumes of every spacing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.envs.observations import SliceGeometry, View
from armscan.envs.slice_observations import LONGEST_SIDE_PX
from armscan.envs.spaces import Parts
from armscan.errors import InvalidValueError
from armscan.utils.compilation import cached_njit
from armscan.utils.validation import check_float, check_numbers
from armscan.volumes import LANDMARK_LABELS

# The highest value of a pixel: all of it is of the tissue.
FULL = 255
# Relative tolerance for the field of view to be a whole number of pixels.
ROUNDING = 1e-6
# For each pixel of the slice along an axis: the index of the first pixel of the image that it overlaps, and the
# fractions of this and the following image pixels that it covers.
Overlaps = tuple[NDArray[np.int64], NDArray[np.float32]]


class MetricSliceObservation:
    """Shares of bones, tendons and artery in each pixel of an image centred on the slice, with pixels sized in mm.

    A pixel is the mean of what the slice shows in its area, from 0 to 255, so that small structures fade but move
    smoothly, and volumes of any spacing give the same image. Outside the slice it is 0.

    Args:
        field_of_view_mm: Size (across, depth) of the image in mm, each above 0, at most 1e6. Default: (97.2, 44.0).
        pixel_mm: Size (across, depth) of a pixel in mm, each above 0, at most 1e6. Default: (1.62, 1.1).

    Raises:
        InvalidValueError: If a size is out of range, or the field of view is not 1 to 4096 whole pixels each way.
    """

    def __init__(
        self, *, field_of_view_mm: Sequence[float] = (97.2, 44.0), pixel_mm: Sequence[float] = (1.62, 1.1)
    ) -> None:
        field_mm = check_numbers("field_of_view_mm", field_of_view_mm, 2, "(across, depth)")
        self._pixel_mm = check_numbers("pixel_mm", pixel_mm, 2, "(across, depth)")
        for name, sizes in (("field_of_view_mm", field_mm), ("pixel_mm", self._pixel_mm)):
            for size in sizes:
                check_float(f"each of {name} = {sizes}", size, above=0.0, at_most=1e6)
        sides = [field / pixel for field, pixel in zip(field_mm, self._pixel_mm, strict=True)]
        if not all(0.5 < side < LONGEST_SIDE_PX + 0.5 and abs(side - round(side)) <= ROUNDING * side for side in sides):
            raise InvalidValueError(
                f"field_of_view_mm is {field_mm} and pixel_mm is {self._pixel_mm}, which gives "
                f"{sides[0]:g} x {sides[1]:g} pixels, but each must be a whole number from 1 to {LONGEST_SIDE_PX}"
            )
        self._shape = round(sides[0]), round(sides[1])
        self._overlaps: dict[SliceGeometry, tuple[Overlaps, Overlaps]] = {}

    def spaces(self, geometries: Sequence[SliceGeometry], n_action: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`."""
        return {"shares": spaces.Box(0, FULL, (len(LANDMARK_LABELS), *self._shape), np.uint8)}

    def observe(self, view: View) -> Parts:
        """See `Observation.observe`."""
        return {"shares": self.observe_all([view])["shares"][0]}

    def observe_all(self, views: Sequence[View]) -> Parts:
        """See `observe_all`."""
        shares = np.empty((len(views), len(LANDMARK_LABELS), *self._shape), dtype=np.uint8)
        for view, image in zip(views, shares, strict=True):
            geometry = view.geometry
            if geometry not in self._overlaps:
                axes = zip(geometry.shape, geometry.pixel_mm, self._shape, self._pixel_mm, strict=True)
                across, depth = (_overlaps(*axis) for axis in axes)
                self._overlaps[geometry] = across, depth
            _pool(view.slice_xz, *self._overlaps[geometry], image)
        return {"shares": shares}


def _overlaps(n: int, size_mm: float, m: int, pixel_mm: float) -> Overlaps:
    """Return the overlaps of n pixels of the slice with m pixels of the image, centred on each other, along an axis."""
    edges = ((np.arange(n + 1) - n / 2) * size_mm) / pixel_mm + m / 2
    first = np.clip(np.floor(edges[:-1]), 0, m).astype(np.int64)
    last = np.clip(np.ceil(edges[1:]), 0, m).astype(np.int64)
    pixels = first[:, None] + np.arange(max(1, int((last - first).max())))
    shares = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return first, np.where(pixels < m, np.maximum(shares, 0.0), 0.0).astype(np.float32)


@cached_njit(nogil=True, error_model="numpy")
def _pool(slice_xz: NDArray[np.uint8], across: Overlaps, depth: Overlaps, image: NDArray[np.uint8]) -> None:
    """Fill an image with the share of each pixel that bones, tendons and artery, labels 1 to 3, cover."""
    (first_row, row_shares), (first_col, col_shares) = across, depth
    n_tissues, n_rows, n_cols = image.shape
    shares = np.zeros((n_rows, n_tissues, n_cols), dtype=np.float32)
    line = np.zeros((n_tissues, n_cols), dtype=np.float32)
    for i in range(slice_xz.shape[0]):
        if row_shares[i, 0] == 0.0:
            continue
        line[:] = 0.0
        is_empty = True
        for k in range(slice_xz.shape[1]):
            label = slice_xz[i, k]
            if 0 < label <= n_tissues:
                is_empty = False
                for j in range(min(col_shares.shape[1], n_cols - first_col[k])):
                    line[label - 1, first_col[k] + j] += col_shares[k, j]
        if is_empty:
            continue
        for j in range(min(row_shares.shape[1], n_rows - first_row[i])):
            share, total = row_shares[i, j], shares[first_row[i] + j]
            if share > 0.0:
                for tissue in range(n_tissues):
                    for col in range(n_cols):
                        total[tissue, col] += share * line[tissue, col]
    for tissue in range(n_tissues):
        for row in range(n_rows):
            for col in range(n_cols):
                image[tissue, row, col] = np.uint8(min(shares[row, tissue, col], np.float32(1.0)) * FULL + 0.5)

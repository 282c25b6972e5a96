"""The slice itself as an observation: one image of labels, or one channel for each landmark tissue."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.envs.observations import SliceGeometry, View, smallest_shape
from armscan.envs.spaces import Parts
from armscan.errors import InvalidValueError
from armscan.utils.compilation import cached_njit
from armscan.utils.validation import check_ints
from armscan.volumes import LABEL_NAMES, LANDMARK_LABELS

Shape = tuple[int, int]
LONGEST_SIDE_PX = 4096
# Priority of the labels that meet in a reduced pixel: the rarer one, which would get lost otherwise, wins.
RANKS = np.array([0, 1, 2, 4, 3], dtype=np.uint8)
LABEL_OF_RANK = np.argsort(RANKS).astype(np.uint8)


class _FramedSlice:
    """Brings slices of different volumes to one shape.

    A slice is cropped to `crop` about its middle; of an odd surplus the larger half is cut from the low side. Then, if
    `shape` is given, it is reduced (or enlarged) to that shape: pixel i of m covers pixels i n / m to (i + 1) n / m of
    the original n, and shows the highest value among them, so that thin structures stay visible.
    """

    def __init__(self, *, crop: Sequence[int] | None = None, shape: Sequence[int] | None = None) -> None:
        self._crop = None if crop is None else _checked_shape("crop", crop)
        self._shape = None if shape is None else _checked_shape("shape", shape)

    def _observed_shape(self, geometries: Sequence[SliceGeometry]) -> Shape:
        """Return the shape of the observed image; raise `InvalidValueError` if it does not fit into all slices."""
        smallest = smallest_shape([each.shape for each in geometries])
        if self._crop is not None and (self._crop[0] > smallest[0] or self._crop[1] > smallest[1]):
            raise InvalidValueError(
                f"crop is {self._crop}, but it must be at most {smallest}, which fits into the slices (across, depth) "
                "of all volumes"
            )
        return self._shape or self._crop or smallest

    def _cropped(self, view: View) -> NDArray[np.uint8]:
        crop = self._crop or view.smallest_shape
        first = [(n - wanted + 1) // 2 for n, wanted in zip(view.slice_xz.shape, crop, strict=True)]
        return view.slice_xz[first[0] : first[0] + crop[0], first[1] : first[1] + crop[1]]


@cached_njit(nogil=True)
def _reduce(image: NDArray[np.uint8], reduced: NDArray[np.uint8]) -> None:
    """Fill each pixel with the highest value of the pixels that it covers."""
    (n_rows, n_cols), (m_rows, m_cols) = image.shape, reduced.shape
    for i in range(m_rows):
        for k in range(m_cols):
            highest = np.uint8(0)
            for row in range(i * n_rows // m_rows, ((i + 1) * n_rows + m_rows - 1) // m_rows):
                for col in range(k * n_cols // m_cols, ((k + 1) * n_cols + m_cols - 1) // m_cols):
                    highest = max(highest, image[row, col])
            reduced[i, k] = highest


class SliceObservation(_FramedSlice):
    """The slice as one image of labels, uint8: 0 background, 1 bones, 2 tendons, 3 artery, 4 nerve.

    A reduced pixel shows the rarest tissue of those that meet in it: artery, nerve, tendons, bones, in this order.

    Args:
        crop: Size (across, depth) in pixels of the middle part to keep, each from 1 to 4096. Default: None, the
            largest shape that fits into all slices.
        shape: Size (across, depth) in pixels to reduce it to, each from 1 to 4096. Default: None, no reduction.

    Raises:
        InvalidValueError: If a shape is not two whole numbers from 1 to 4096.
    """

    def spaces(self, geometries: Sequence[SliceGeometry], n_action: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`."""
        return {"slice": spaces.Box(0, max(LABEL_NAMES), self._observed_shape(geometries), np.uint8)}

    def observe(self, view: View) -> Parts:
        """See `Observation.observe`."""
        cropped = self._cropped(view)
        if self._shape is None:
            return {"slice": cropped.copy()}
        reduced = np.empty(self._shape, dtype=np.uint8)
        _reduce(RANKS[cropped], reduced)
        return {"slice": LABEL_OF_RANK[reduced]}


class SliceChannelsObservation(_FramedSlice):
    """The slice as one channel for each of bones, tendons and artery, uint8: 1 where that tissue is, 0 elsewhere.

    A reduced pixel is 1 if any of the pixels that it covers is.

    Args:
        crop: Size (across, depth) in pixels of the middle part to keep, each from 1 to 4096. Default: None, the
            largest shape that fits into all slices.
        shape: Size (across, depth) in pixels to reduce it to, each from 1 to 4096. Default: None, no reduction.

    Raises:
        InvalidValueError: If a shape is not two whole numbers from 1 to 4096.
    """

    def spaces(self, geometries: Sequence[SliceGeometry], n_action: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`."""
        shape = (len(LANDMARK_LABELS), *self._observed_shape(geometries))
        return {"channels": spaces.Box(0, 1, shape, np.uint8)}

    def observe(self, view: View) -> Parts:
        """See `Observation.observe`."""
        cropped = self._cropped(view)
        channels = np.empty((len(LANDMARK_LABELS), *(self._shape or cropped.shape)), dtype=np.uint8)
        for channel, label in zip(channels, LANDMARK_LABELS, strict=True):
            if self._shape is None:
                np.equal(cropped, label, out=channel.view(np.bool_))
            else:
                _reduce((cropped == label).view(np.uint8), channel)
        return {"channels": channels}


def _checked_shape(name: str, shape: Any) -> Shape:
    across, depth = check_ints(name, shape, 2, "(across, depth)", at_least=1, at_most=LONGEST_SIDE_PX)
    return across, depth

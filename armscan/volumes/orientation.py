"""Axes of a file: their order, their anatomical orientation, and the crop along them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from armscan.errors import InvalidValueError
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_numbers

AXES = "xyz"
# Each world axis runs from the first towards the second: right, left, anterior, posterior, inferior, superior.
WORLD_AXES = ("RL", "AP", "IS")

# Range (from, to) in mm along each cropped axis.
Crop = dict[str, tuple[float, float]]


def check_axes(value: Any) -> str:
    """Return the order of axes, such as 'zxy', if it names x, y and z once each."""
    if not isinstance(value, str) or sorted(value) != list(AXES):
        raise InvalidValueError(f"axes is {value!r}, but it must be the letters x, y and z in some order")
    return value


def check_orientation(value: Any) -> str | None:
    """Return an orientation, such as 'LPS', if it names one direction of each anatomical axis; None stays None."""
    if value is None:
        return None
    is_code = isinstance(value, str) and len(value) == 3
    if not is_code or any(sum(letter in pair for letter in value) != 1 for pair in WORLD_AXES):
        raise InvalidValueError(
            f"orientation is {value!r}, but it must be null (as in the file) or three letters, one of R and L, one of "
            "A and P, one of S and I: the directions of the file's first, second and third axis"
        )
    return str(value)


def check_crop(value: Any) -> Crop | None:
    """Return the checked crop, ranges along some axes such as {'y': (20.0, 180.0)} in mm; None stays None."""
    if value is None:
        return None
    if not isinstance(value, Mapping) or not value or any(axis not in tuple(AXES) for axis in value):
        raise InvalidValueError(
            f"crop_mm is {value!r}, but it must give [from, to] in mm for some of the axes x, y and z"
        )
    crop = {}
    for axis, bounds in value.items():
        low, high = check_numbers(f"crop_mm of {axis}", bounds, 2, "[from, to] in mm")
        if low > high:
            raise InvalidValueError(f"crop_mm of {axis} is {bounds!r}, but it must begin before it ends")
        crop[axis] = (low, high)
    return crop


def orientation_of(direction: FloatArray) -> str:
    """Return the directions of the axes, such as 'LPS'; oblique axes get the letters of the nearest such orientation.

    Args:
        direction: Directions of the axes in the world (left, posterior, superior), as columns, shape (3, 3).
    """
    # Deferred: phantoms need no reader.
    import SimpleITK

    orientation_from: Callable[[list[float]], str] = SimpleITK.DICOMOrientImageFilter.GetOrientationFromDirectionCosines
    return orientation_from(np.ravel(direction).tolist())

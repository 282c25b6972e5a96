"""The slicing plane in the volume's own frame (mm, axes along the array), and the distance between two planes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from armscan.utils.arrays import FloatArray
from armscan.utils.compilation import cached_njit
from armscan.utils.validation import check_numbers


@cached_njit()
def rotation_matrix(rz_deg: float, rx_deg: float) -> FloatArray:
    """Return Rz(rz) Rx(rx), 3 x 3: a rotation about X, then one about Z."""
    cos_z, sin_z = math.cos(math.radians(rz_deg)), math.sin(math.radians(rz_deg))
    cos_x, sin_x = math.cos(math.radians(rx_deg)), math.sin(math.radians(rx_deg))
    matrix = np.empty((3, 3))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = cos_z, -sin_z * cos_x, sin_z * sin_x
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = sin_z, cos_z * cos_x, -cos_z * sin_x
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = 0.0, sin_x, cos_x
    return matrix


@dataclass(frozen=True)
class ManipulatorAction:
    """One slicing plane, absolute in the volume's frame.

    A point p of the plane's frame, X across and Z in depth, lies at Rz(rz) Rx(rx) p + (tx, ty, 0) in the volume.

    Args:
        rotation: Angles (rz, rx) in degrees.
        translation: Offsets (tx, ty) in mm.

    Raises:
        InvalidValueError: If a component is not a finite number.
    """

    rotation: tuple[float, float]
    translation: tuple[float, float]

    def __post_init__(self) -> None:
        rz, rx = check_numbers("rotation", self.rotation, 2, "(rz, rx) in degrees")
        tx, ty = check_numbers("translation", self.translation, 2, "(tx, ty) in mm")
        object.__setattr__(self, "rotation", (rz, rx))
        object.__setattr__(self, "translation", (tx, ty))

    @classmethod
    def of_finite(cls, rotation: tuple[float, float], translation: tuple[float, float]) -> Self:
        """Build the action from plain floats known to be finite, without validation: the fast path of each step."""
        action = object.__new__(cls)
        action.__dict__.update(rotation=rotation, translation=translation)
        return action

    @classmethod
    def from_array(cls, components: FloatArray) -> Self:
        """Build the action from its four components (rz, rx, tx, ty) in degrees and mm."""
        rz, rx, tx, ty = check_numbers("components", components, 4, "(rz, rx) in degrees and (tx, ty) in mm")
        return cls(rotation=(rz, rx), translation=(tx, ty))

    def to_array(self) -> FloatArray:
        """Return (rz, rx, tx, ty) in degrees and mm."""
        return np.array([*self.rotation, *self.translation])

    @cached_property
    def matrix(self) -> FloatArray:
        """Rz(rz) Rx(rx), 3 x 3."""
        return rotation_matrix(*self.rotation)

    @property
    def offset_mm(self) -> FloatArray:
        """Return the plane's origin in the volume, (tx, ty, 0) in mm."""
        return np.array([*self.translation, 0.0])

    @property
    def normal(self) -> FloatArray:
        """The plane's unit normal, the image of the Y axis."""
        return self.matrix[:, 1]


def wrap_deg(angle_deg: float) -> float:
    """Return the angle in (-180, 180]."""
    return float(180.0 - (180.0 - angle_deg) % 360.0)


def shift_into(action: ManipulatorAction, bounds_mm: tuple[float, float]) -> ManipulatorAction | None:
    """Slide the plane's origin across, within the plane and as little as possible, until (tx, ty) is in [0, bounds_mm].

    Returns:
        The same plane with its slice shifted across; None if no shift brings the origin into the bounds.
    """
    direction = action.matrix[:2, 0].tolist()
    lowest, highest = -np.inf, np.inf
    for position, step, bound in zip(action.translation, direction, bounds_mm, strict=True):
        if abs(step) < 1e-12:
            if not 0.0 <= position <= bound:
                return None
            continue
        low, high = sorted(((0.0 - position) / step, (bound - position) / step))
        lowest, highest = max(lowest, low), min(highest, high)
    if lowest > highest:
        return None
    shift_mm = min(max(0.0, lowest), highest)
    tx, ty = (
        min(max(position + shift_mm * step, 0.0), bound)
        for position, step, bound in zip(action.translation, direction, bounds_mm, strict=True)
    )
    return ManipulatorAction.of_finite(action.rotation, (tx, ty))


def plane_distance(
    action: ManipulatorAction, optimum: ManipulatorAction, centre_mm: tuple[float, float]
) -> tuple[float, float]:
    """Measure how far a plane is from the optimal one.

    Args:
        action: Plane to measure.
        optimum: Optimal plane, in the same frame.
        centre_mm: Centre of the slice in the plane's frame, (across, depth) in mm.

    Returns:
        The offset in mm of the slice's centre from the optimal plane along its normal, and the angle in degrees, in
        [0, 90], between the planes' normals.
    """
    offset_mm, cos = _offset_and_cosine(
        action.rotation, action.translation, optimum.rotation, optimum.translation, centre_mm
    )
    return abs(offset_mm), math.degrees(math.acos(min(1.0, abs(cos))))


@cached_njit()
def _offset_and_cosine(
    rotation: tuple[float, float],
    translation: tuple[float, float],
    optimal_rotation: tuple[float, float],
    optimal_translation: tuple[float, float],
    centre_mm: tuple[float, float],
) -> tuple[float, float]:
    """Return the signed offset in mm and the cosine of the angle that `plane_distance` measures."""
    matrix, normal = rotation_matrix(rotation[0], rotation[1]), rotation_matrix(*optimal_rotation)[:, 1]
    origin_mm, optimal_origin_mm = (*translation, 0.0), (*optimal_translation, 0.0)
    offset_mm = cos = 0.0
    for axis in range(3):
        centre = matrix[axis, 0] * centre_mm[0] + matrix[axis, 2] * centre_mm[1] + origin_mm[axis]
        offset_mm += normal[axis] * (centre - optimal_origin_mm[axis])
        cos += matrix[axis, 1] * normal[axis]
    return offset_mm, cos

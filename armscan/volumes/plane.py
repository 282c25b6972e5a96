"""The slicing plane and the rigid motions it is moved by, in the volume's own frame (mm, axes along the array)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from armscan.checks import check_numbers
from armscan.errors import InvalidValueError

FloatArray = NDArray[np.float64]


def rotation_z(angle_deg: float) -> FloatArray:
    """Returns the 3 x 3 matrix of a rotation about Z by `angle_deg` degrees."""
    cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def rotation_x(angle_deg: float) -> FloatArray:
    """Returns the 3 x 3 matrix of a rotation about X by `angle_deg` degrees."""
    cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


@dataclass(frozen=True)
class ManipulatorAction:
    """One slicing plane, absolute in the volume's frame.

    A point p of the plane's frame, X across and Z in depth, lies at Rz(rz) Rx(rx) p + (tx, ty, 0) in the volume.

    Args:
        rotation: (rz, rx) in degrees.
        translation: (tx, ty) in mm.

    Raises:
        InvalidValueError: if a component is not a finite number.
    """

    rotation: tuple[float, float]
    translation: tuple[float, float]

    def __post_init__(self) -> None:
        rz, rx = check_numbers("rotation", self.rotation, 2, "(rz, rx) in degrees")
        tx, ty = check_numbers("translation", self.translation, 2, "(tx, ty) in mm")
        object.__setattr__(self, "rotation", (rz, rx))
        object.__setattr__(self, "translation", (tx, ty))

    @classmethod
    def from_array(cls, components: FloatArray) -> Self:
        """Builds the action from its four components (rz, rx, tx, ty) in degrees and mm."""
        rz, rx, tx, ty = check_numbers("components", components, 4, "(rz, rx) in degrees and (tx, ty) in mm")
        return cls(rotation=(rz, rx), translation=(tx, ty))

    def to_array(self) -> FloatArray:
        """Returns (rz, rx, tx, ty) in degrees and mm."""
        return np.array([*self.rotation, *self.translation])

    @cached_property
    def matrix(self) -> FloatArray:
        """Rz(rz) Rx(rx), 3 x 3."""
        return rotation_z(self.rotation[0]) @ rotation_x(self.rotation[1])

    @property
    def offset_mm(self) -> FloatArray:
        """Where the plane's origin lies in the volume: (tx, ty, 0)."""
        return np.array([*self.translation, 0.0])

    @property
    def normal(self) -> FloatArray:
        """The plane's unit normal, the image of the Y axis."""
        return self.matrix[:, 1]


@dataclass(frozen=True)
class RigidTransform:
    """A rigid motion T(q) = R (q - c) + c + t of the volume's frame; the moved volume is V'(q) = V(T(q)).

    Args:
        rotation: (rz, rx) in degrees, R = Rz(rz) Rx(rx).
        translation: t = (tx, ty) in mm; nothing moves in depth.
        centre_mm: c, the point that the rotation leaves in place.

    Raises:
        InvalidValueError: if a component is not a finite number.
    """

    rotation: tuple[float, float] = (0.0, 0.0)
    translation: tuple[float, float] = (0.0, 0.0)
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_numbers("rotation", self.rotation, 2, "(rz, rx) in degrees")
        check_numbers("translation", self.translation, 2, "(tx, ty) in mm")
        check_numbers("centre_mm", self.centre_mm, 3, "(x, y, z) in mm")

    @cached_property
    def matrix(self) -> FloatArray:
        """R, 3 x 3."""
        return rotation_z(self.rotation[0]) @ rotation_x(self.rotation[1])

    @cached_property
    def offset_mm(self) -> FloatArray:
        """The b of the affine form T(q) = R q + b."""
        centre_mm: FloatArray = np.asarray(self.centre_mm)
        offset_mm: FloatArray = centre_mm + np.array([*self.translation, 0.0]) - self.matrix @ centre_mm
        return offset_mm

    def plane_map(self, action: ManipulatorAction) -> tuple[FloatArray, FloatArray]:
        """Returns (M, b) with T(plane(p)) = M p + b: from the plane's frame into the unmoved volume."""
        return self.matrix @ action.matrix, self.matrix @ action.offset_mm + self.offset_mm

    def inverse_plane(self, action: ManipulatorAction) -> ManipulatorAction:
        """Returns the plane of the moved volume that shows what `action` shows of the unmoved one.

        The result is the same set of points. Where the motion turns about X as well, the picture may be turned and
        shifted within the plane, because a `ManipulatorAction` has neither a rotation about Y nor a shift in depth.

        Raises:
            InvalidValueError: if the moved plane never meets the volume's floor z = 0, where every plane begins.
        """
        normal = self.matrix.T @ action.normal
        origin_mm = self.matrix.T @ (action.offset_mm - self.offset_mm)
        rx = np.arcsin(np.clip(normal[2], -1.0, 1.0))
        rz = np.arctan2(-normal[0], normal[1])
        # The same plane has two descriptions; the one on the same side as `action` keeps the picture upright.
        if np.cos(np.deg2rad(action.rotation[1])) < 0:
            rx, rz = np.pi - rx, np.arctan2(normal[0], -normal[1])
        moved = ManipulatorAction((wrapped_deg(np.rad2deg(rz)), wrapped_deg(np.rad2deg(rx))), (0.0, 0.0))
        if origin_mm[2] != 0.0:
            in_depth = moved.matrix[:, 2]
            if abs(in_depth[2]) < 1e-9:
                raise InvalidValueError(f"{action}, moved by {self}, lies parallel to the volume's floor and above it")
            origin_mm = origin_mm - origin_mm[2] / in_depth[2] * in_depth
        return ManipulatorAction(moved.rotation, (origin_mm[0], origin_mm[1]))


def wrapped_deg(angle_deg: float) -> float:
    """Returns the angle in (-180, 180]."""
    return float(180.0 - (180.0 - angle_deg) % 360.0)


def slid_into(action: ManipulatorAction, bounds_mm: tuple[float, float]) -> ManipulatorAction | None:
    """Slides the plane's origin along the plane until (tx, ty) lies in [0, bounds_mm], by the shortest way.

    Returns:
        The same plane with its picture shifted across, or None where the plane misses the box altogether.
    """
    direction = action.matrix[:2, 0]
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
    slid = np.clip(np.array(action.translation) + shift_mm * direction, 0.0, bounds_mm)
    return ManipulatorAction(action.rotation, (slid[0], slid[1]))


def plane_distance(
    action: ManipulatorAction, optimum: ManipulatorAction, centre_mm: tuple[float, float]
) -> tuple[float, float]:
    """Measures how far a plane is from the optimal one.

    Args:
        action: the plane.
        optimum: the optimal plane, in the same frame.
        centre_mm: centre of the slice in the plane's frame, (across, depth).

    Returns:
        The offset in mm of the slice's centre from the optimal plane along its normal, and the angle in degrees, in
        [0, 90], between the planes' normals.
    """
    centre = action.matrix @ np.array([centre_mm[0], 0.0, centre_mm[1]]) + action.offset_mm
    offset_mm = abs(float(optimum.normal @ (centre - optimum.offset_mm)))
    cos = min(1.0, abs(float(action.normal @ optimum.normal)))
    return offset_mm, float(np.rad2deg(np.arccos(cos)))

"""Rigid motions of a volume, and the planes that they move."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armscan.errors import InvalidValueError
from armscan.utils.arrays import FloatArray
from armscan.utils.compilation import cached_njit
from armscan.utils.validation import check_numbers
from armscan.volumes.plane import ManipulatorAction, rotation_matrix, wrap_deg

MAX_SHIFT_MM = 1e6
# The maps of an unmoved volume; see `RigidTransform.maps`.
NO_MAPS = np.empty((0, 3, 4))


@cached_njit()
def _composed(
    outer: FloatArray, outer_mm: FloatArray, inner: FloatArray, inner_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (M, b) of the affine map p -> outer (inner p + inner_mm) + outer_mm."""
    matrix, offset_mm = np.zeros((3, 3)), np.zeros(3)
    for i in range(3):
        for k in range(3):
            offset_mm[i] += outer[i, k] * inner_mm[k]
            for j in range(3):
                matrix[i, j] += outer[i, k] * inner[k, j]
        offset_mm[i] += outer_mm[i]
    return matrix, offset_mm


@cached_njit()
def mapped_plane(
    maps: FloatArray, rotation: tuple[float, float], translation: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Return (M, b) of a plane p -> Rz(rz) Rx(rx) p + (tx, ty, 0), taken through `RigidTransform.maps`."""
    matrix, offset_mm = rotation_matrix(rotation[0], rotation[1]), np.zeros(3)
    offset_mm[0], offset_mm[1] = translation
    for i in range(maps.shape[0] - 1, -1, -1):
        matrix, offset_mm = _composed(maps[i, :, :3], maps[i, :, 3], matrix, offset_mm)
    return matrix, offset_mm


@dataclass(frozen=True)
class RigidTransform:
    """A rigid motion T(q) = R (q - c) + c + t of the volume's frame; the moved volume is V'(q) = V(T(q)).

    Args:
        rotation: Angles (rz, rx) in degrees; R = Rz(rz) Rx(rx). Default: zeros.
        translation: Offsets t = (tx, ty) in mm, within +-1e6; the depth does not change. Default: zeros.
        centre_mm: Fixed point c of the rotation, in mm, within +-1e6. Default: zeros.

    Raises:
        InvalidValueError: If a component is not a finite number, or out of its range.
    """

    rotation: tuple[float, float] = (0.0, 0.0)
    translation: tuple[float, float] = (0.0, 0.0)
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_numbers("rotation", self.rotation, 2, "(rz, rx) in degrees")
        shift_mm = check_numbers("translation", self.translation, 2, "(tx, ty) in mm")
        centre_mm = check_numbers("centre_mm", self.centre_mm, 3, "(x, y, z) in mm")
        # Differences of much larger numbers would overflow to NaN.
        if max(map(abs, shift_mm + centre_mm)) > MAX_SHIFT_MM:
            raise InvalidValueError(
                f"translation is {shift_mm} and centre_mm is {centre_mm}, but each must be within +-{MAX_SHIFT_MM:g} mm"
            )

    @cached_property
    def matrix(self) -> FloatArray:
        """R, 3 x 3."""
        return rotation_matrix(*self.rotation)

    @cached_property
    def offset_mm(self) -> FloatArray:
        """The offset b of the affine form T(q) = R q + b, in mm."""
        centre_mm: FloatArray = np.asarray(self.centre_mm)
        offset_mm: FloatArray = centre_mm + np.array([*self.translation, 0.0]) - self.matrix @ centre_mm
        return offset_mm

    @cached_property
    def maps(self) -> FloatArray:
        """The affine maps (A | b) from the moved to the unmoved volume, shape (n, 3, 4); the last is applied first."""
        return np.column_stack([self.matrix, self.offset_mm])[None]

    def plane_map(self, action: ManipulatorAction) -> tuple[FloatArray, FloatArray]:
        """Return (M, b) with T(plane(p)) = M p + b: from the plane's frame into the unmoved volume."""
        return mapped_plane(self.maps, action.rotation, action.translation)

    def inverse_plane(self, action: ManipulatorAction) -> ManipulatorAction:
        """Return the plane of the moved volume that shows the same slice as `action` in the unmoved one.

        The result covers the same points. If the motion also rotates about X, the slice may be rotated and shifted
        within the plane, because a `ManipulatorAction` has neither a rotation about Y nor a shift in depth.

        Raises:
            InvalidValueError: If the moved plane never meets the volume's floor z = 0, where every plane begins.
        """
        n_x, n_y, n_z = (self.matrix.T @ action.normal).tolist()
        x_mm, y_mm, z_mm = (self.matrix.T @ (action.offset_mm - self.offset_mm)).tolist()
        rx, rz = math.asin(min(max(n_z, -1.0), 1.0)), math.atan2(-n_x, n_y)
        # A plane has two normals; the one on the same side as `action` keeps the slice upright.
        if math.cos(math.radians(action.rotation[1])) < 0:
            rx, rz = math.pi - rx, math.atan2(n_x, -n_y)
        rotation = wrap_deg(math.degrees(rz)), wrap_deg(math.degrees(rx))
        if z_mm != 0.0:
            in_depth_x, in_depth_y, in_depth_z = rotation_matrix(*rotation)[:, 2].tolist()
            if abs(in_depth_z) < 1e-9:
                raise InvalidValueError(f"{action}, moved by {self}, lies parallel to the volume's floor and above it")
            x_mm, y_mm = x_mm - z_mm / in_depth_z * in_depth_x, y_mm - z_mm / in_depth_z * in_depth_y
        return ManipulatorAction.of_finite(rotation, (x_mm, y_mm))

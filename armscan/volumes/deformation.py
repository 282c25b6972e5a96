"""Deformations of a volume that keep one plane fixed: other wrists, by lookup instead of resampling."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armscan.errors import InvalidValueError
from armscan.utils.arrays import FloatArray
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.rigid_transform import RigidTransform


@dataclass(frozen=True, eq=False, kw_only=True)
class DeformingTransform(RigidTransform):
    """A rigid motion T of a volume deformed about a plane; the moved volume is V'(q) = V(D(T(q))).

    D maps the plane onto itself. In the plane's frame (across, along its normal, in depth), with `about_mm` as the
    origin, F = `deformation` moves the volume's point x to F x, so that a lookup at x reads F^-1 x. `inverse_plane`
    is exact for this plane; for any other it ignores the deformation.

    Args:
        plane: Plane that the deformation keeps.
        about_mm: Fixed point of the plane, (across, depth) in its frame, in mm.
        deformation: Matrix F, shape (3, 3); its second row is zero except for the stretch along the normal.

    Raises:
        InvalidValueError: If `deformation` is not a finite 3 x 3 matrix, moves the plane, or is singular; or as for
            `RigidTransform`.
    """

    plane: ManipulatorAction
    about_mm: tuple[float, float]
    deformation: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        matrix = self.deformation
        is_map = matrix.shape == (3, 3) and bool(np.isfinite(matrix).all())
        if not is_map or matrix[1, [0, 2]].any() or np.linalg.det(matrix) == 0.0:
            raise InvalidValueError(
                f"deformation is {matrix.tolist()}, but it must be finite, 3 x 3 and invertible, with a "
                "second row of (0, s, 0)"
            )

    @cached_property
    def maps(self) -> FloatArray:
        """The affine maps (A | b) of D and T, in this order; T is applied first. See `RigidTransform.maps`."""
        frame = self.plane.matrix
        matrix: FloatArray = frame @ np.linalg.inv(self.deformation) @ frame.T
        across_mm, depth_mm = self.about_mm
        kept_mm = frame @ np.array([across_mm, 0.0, depth_mm]) + self.plane.offset_mm
        return np.array([np.column_stack([matrix, kept_mm - matrix @ kept_mm]), *super().maps])

"""Deformations that keep a plane."""

import numpy as np
import pytest

from armscan.errors import InvalidValueError
from armscan.volumes import DeformingTransform, ManipulatorAction, RigidTransform

PLANE = ManipulatorAction((12.0, -7.0), (3.0, 40.0))
MOTION = ((5.0, 2.0), (4.0, -6.0), (30.0, 60.0, 10.0))
DEFORMATION = np.array([[1.1, 0.05, -0.08], [0.0, 0.9, 0.0], [0.03, -0.06, 1.02]])


def deforming(deformation=DEFORMATION):
    return DeformingTransform(*MOTION, plane=PLANE, about_mm=(20.0, 12.0), deformation=np.asarray(deformation))


def test_a_lookup_goes_through_the_motion_and_then_back_through_the_deformation():
    action = ManipulatorAction((-3.0, 4.0), (10.0, 50.0))
    matrix, offset_mm = deforming().plane_map(action)
    rigid_matrix, rigid_offset_mm = RigidTransform(*MOTION).plane_map(action)
    about = PLANE.matrix @ np.array([20.0, 0.0, 12.0]) + PLANE.offset_mm
    for point in np.random.default_rng(0).uniform(-50.0, 50.0, (10, 3)):
        moved = rigid_matrix @ point + rigid_offset_mm
        in_frame = np.linalg.solve(DEFORMATION, PLANE.matrix.T @ (moved - about))
        np.testing.assert_allclose(matrix @ point + offset_mm, PLANE.matrix @ in_frame + about)


def test_without_a_deformation_only_the_motion_is_left():
    action = ManipulatorAction((-3.0, 4.0), (10.0, 50.0))
    for ours, rigid in zip(
        deforming(np.eye(3)).plane_map(action), RigidTransform(*MOTION).plane_map(action), strict=True
    ):
        np.testing.assert_allclose(ours, rigid, atol=1e-12)


@pytest.mark.parametrize(
    "deformation", [np.eye(2), np.diag([1.0, 1.0, 0.0]), np.diag([1.0, 1.0, np.nan]), np.ones((3, 3))]
)
def test_deformations_that_move_the_plane_or_leave_nothing_are_refused(deformation):
    with pytest.raises(InvalidValueError, match="deformation is"):
        deforming(deformation)

"""Rigid motions of a volume."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armscan.errors import InvalidValueError
from armscan.volumes import ManipulatorAction, RigidTransform
from tests.volumes.test_plane import actions, any_mm, moderate_deg


@pytest.mark.parametrize("bad", [{"rotation": 3}, {"translation": (1, 2, 3)}, {"centre_mm": (1, 2)}])
def test_transform_refuses_what_is_not_finite_numbers(bad):
    with pytest.raises(InvalidValueError, match=f"{next(iter(bad))} is"):
        RigidTransform(**bad)


def test_inverse_plane_refuses_a_plane_that_never_meets_the_floor():
    with pytest.raises(InvalidValueError, match="parallel to the volume's floor"):
        RigidTransform((0.0, 180.0), centre_mm=(0.0, 0.0, 5.0)).inverse_plane(
            ManipulatorAction((0.0, 90.0), (0.0, 0.0))
        )


@given(actions, st.tuples(moderate_deg, st.floats(-5, 5), any_mm, any_mm))
def test_inverse_plane_is_mapped_onto_the_plane(action, moved):
    transform = RigidTransform(moved[:2], moved[2:], (30.0, 100.0, 20.0))
    inverse = transform.inverse_plane(action)
    matrix, offset_mm = transform.plane_map(inverse)
    np.testing.assert_allclose(abs(matrix[:, 1] @ action.normal), 1.0, atol=1e-9)
    np.testing.assert_allclose(action.normal @ (offset_mm - action.offset_mm), 0.0, atol=1e-6)


@given(actions, st.tuples(moderate_deg, any_mm, any_mm))
def test_inverse_plane_of_a_turn_about_z_shows_the_same_picture(action, moved):
    transform = RigidTransform((moved[0], 0.0), moved[1:], (30.0, 100.0, 20.0))
    matrix, offset_mm = transform.plane_map(transform.inverse_plane(action))
    np.testing.assert_allclose(matrix, action.matrix, atol=1e-9)
    np.testing.assert_allclose(offset_mm, action.offset_mm, atol=1e-6)

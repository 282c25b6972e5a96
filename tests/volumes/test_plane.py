"""The plane, and the distance between planes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armscan.errors import InvalidValueError
from armscan.volumes import ManipulatorAction, plane_distance, shift_into
from armscan.volumes.plane import wrap_deg

moderate_deg = st.floats(-80, 80)
any_mm = st.floats(-100, 100)
actions = st.builds(ManipulatorAction, st.tuples(moderate_deg, moderate_deg), st.tuples(any_mm, any_mm))


@pytest.mark.parametrize("bad", [(1.0,), (1.0, float("nan")), (float("inf"), 0.0), "ab", None, (1, 2, 3)])
def test_action_refuses_what_is_not_two_finite_numbers(bad):
    with pytest.raises(InvalidValueError, match="rotation is"):
        ManipulatorAction(bad, (0.0, 0.0))
    with pytest.raises(InvalidValueError, match="translation is"):
        ManipulatorAction((0.0, 0.0), bad)


@pytest.mark.parametrize("components", [None, (1, 2, 3), (1, 2, 3, float("nan"))])
def test_action_from_array_refuses_what_is_not_four_numbers(components):
    with pytest.raises(InvalidValueError, match="components is"):
        ManipulatorAction.from_array(components)


def test_action_matrix_turns_about_x_first_and_z_second():
    matrix = ManipulatorAction((90.0, 90.0), (0.0, 0.0)).matrix
    np.testing.assert_allclose(matrix @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(matrix @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@given(actions, st.tuples(st.floats(0, 100), st.floats(0, 100)))
def test_slid_into_keeps_the_plane_and_enters_the_bounds(action, bounds_mm):
    slid = shift_into(action, bounds_mm)
    if slid is None:
        direction = action.matrix[:2, 0]
        steps = np.linspace(-1000, 1000, 20001)[:, None]
        path = np.array(action.translation) + steps * direction
        strictly_inside = ((path > 0.1) & (path < np.array(bounds_mm) - 0.1)).all(axis=1)
        assert not strictly_inside.any()
    else:
        assert all(0 <= position <= bound for position, bound in zip(slid.translation, bounds_mm, strict=True))
        assert slid.rotation == action.rotation
        assert action.normal @ (slid.offset_mm - action.offset_mm) == pytest.approx(0, abs=1e-6)


def test_slid_into_leaves_a_plane_within_the_bounds_where_it_is():
    action = ManipulatorAction((12.0, 3.0), (4.0, 5.0))
    assert shift_into(action, (10.0, 10.0)) == action


@pytest.mark.parametrize(("angle", "wrapped"), [(0, 0), (180, 180), (-180, 180), (190, -170), (-361, -1), (540, 180)])
def test_angle_is_wrapped_into_its_range(angle, wrapped):
    assert wrap_deg(angle) == pytest.approx(wrapped)


def test_plane_distance_of_parallel_planes_is_their_offset():
    at_5, at_8 = (ManipulatorAction((0.0, 0.0), (0.0, ty)) for ty in (5.0, 8.0))
    assert plane_distance(at_5, at_8, (10.0, 4.0)) == pytest.approx((3.0, 0.0))


def test_plane_distance_is_measured_at_the_centre_of_the_slice():
    turned, flat = ManipulatorAction((30.0, 0.0), (0.0, 5.0)), ManipulatorAction((0.0, 0.0), (0.0, 5.0))
    assert plane_distance(turned, flat, (10.0, 4.0)) == pytest.approx((5.0, 30.0))


def test_plane_distance_of_opposite_normals_is_no_angle():
    upright, reversed_ = ManipulatorAction((0.0, 0.0), (0.0, 5.0)), ManipulatorAction((180.0, 0.0), (20.0, 5.0))
    assert plane_distance(reversed_, upright, (10.0, 4.0)) == pytest.approx((0.0, 0.0))

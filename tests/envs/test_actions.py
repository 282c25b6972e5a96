"""Normalised actions and projections."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armscan.envs import ActionBounds, ManipulatorAction
from armscan.envs.actions import free_components
from armscan.errors import InvalidValueError

BOUNDS = ActionBounds((90.0, 45.0), (100.0, 200.0))


@pytest.mark.parametrize(
    ("normalised", "action"),
    [
        ([0, 0, 0, 0], ManipulatorAction((0, 0), (50, 100))),
        ([1, 1, 1, 1], ManipulatorAction((90, 45), (100, 200))),
        ([-1, -1, -1, -1], ManipulatorAction((-90, -45), (0, 0))),
    ],
)
def test_bounds_turn_normalised_vectors_into_planes(normalised, action):
    assert BOUNDS.denormalise(np.array(normalised, float)) == action


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4))
def test_normalised_is_the_inverse_of_denormalised(normalised):
    np.testing.assert_allclose(BOUNDS.normalised(BOUNDS.denormalise(np.array(normalised))), normalised, atol=1e-12)


def test_zero_bounds_fix_their_components_at_zero():
    bounds = ActionBounds((0.0, 10.0), (0.0, 50.0))
    action = bounds.denormalise(np.ones(4))
    assert action == ManipulatorAction((0, 10), (0, 50))
    np.testing.assert_array_equal(bounds.normalised(action), [0, 1, -1, 1])


@pytest.mark.parametrize("rotation", [(181.0, 1.0), (-1.0, 1.0), (float("nan"), 1.0)])
def test_bounds_refuse_impossible_rotations(rotation):
    with pytest.raises(InvalidValueError, match="rotation bound"):
        ActionBounds(rotation, (1.0, 1.0))


def test_bounds_refuse_negative_translations():
    with pytest.raises(InvalidValueError, match="translation bound of ty"):
        ActionBounds((1.0, 1.0), (1.0, -1.0))


@pytest.mark.parametrize(
    ("projection", "indices"),
    [("x", (2,)), ("y", (3,)), ("xy", (2, 3)), ("zy", (0, 3)), ("full", (0, 1, 2, 3)), (["ty", "rx"], (1, 3))],
)
def test_projection_names_its_free_components(projection, indices):
    assert free_components(projection) == indices


@pytest.mark.parametrize("projection", ["z", "", [], ["rz", "rz"], ["ry"]])
def test_free_components_refuse_an_unknown_projection(projection):
    with pytest.raises(InvalidValueError, match=r"projection is .* x, y, xy, zy or full"):
        free_components(projection)

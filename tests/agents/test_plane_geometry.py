"""Planes in the frames of others, for tensors, compared with computing them one by one."""

import numpy as np
import pytest
import torch

from armscan.agents.plane_geometry import PlaneGeometry
from armscan.envs.actions import ActionBounds
from armscan.volumes.plane import ManipulatorAction, plane_distance, shift_into

BOUNDS, MIDDLE = ActionBounds((90.0, 45.0), (97.2, 216.0)), (48.5, 21.75)


@pytest.fixture
def geometry():
    return PlaneGeometry(BOUNDS, MIDDLE).double()


def drawn(seed, n=200):
    rng = np.random.default_rng(seed)
    return torch.tensor(rng.uniform([-25, -15, 0, 60], [25, 15, 60, 160], (n, 4)))


def one_by_one(planes):
    return [ManipulatorAction.from_array(plane) for plane in planes.numpy()]


def test_actions_are_planes_normalised(geometry):
    planes = drawn(0)
    for plane, action in zip(one_by_one(planes), geometry.actions(planes).numpy(), strict=True):
        np.testing.assert_allclose(action, BOUNDS.normalised(plane), atol=1e-6)
    np.testing.assert_allclose(geometry.planes(geometry.actions(planes)), planes, atol=1e-9)


def test_errors_are_distances_of_planes(geometry):
    planes, optima = drawn(0), drawn(1)
    expected = [plane_distance(*each, MIDDLE) for each in zip(one_by_one(planes), one_by_one(optima), strict=True)]
    np.testing.assert_allclose(geometry.errors(planes, optima), expected, atol=1e-6)


def test_a_plane_is_found_again_from_where_another_sees_it(geometry):
    planes, others = drawn(0), drawn(1)
    found = geometry.from_frame(planes, geometry.seen_from(planes, others), torch.zeros(len(planes)).double())
    np.testing.assert_allclose(geometry.errors(found, others), 0.0, atol=1e-5)
    # Its slice hardly moves across: only the depth of its middle changes that.
    assert (found - others)[:, 2].abs().median() < 1.0


def test_a_plane_beside_another_is_parallel_and_as_far_along_the_normal(geometry):
    planes, others = drawn(0), drawn(1)
    seen = geometry.seen_from(planes, others)
    beside = geometry.from_frame(planes, seen, torch.full((len(planes),), 9.0).double())
    errors = geometry.errors(beside, others)
    np.testing.assert_allclose(errors[:, 0], 9.0, atol=1e-4)
    np.testing.assert_allclose(errors[:, 1], 0.0, atol=1e-4)
    between = geometry.errors(beside, geometry.from_frame(planes, seen, torch.full((len(planes),), -9.0).double()))
    np.testing.assert_allclose(between[:, 0], 18.0, atol=1e-4)


@pytest.mark.parametrize("tx_mm", [-45.0, 65.0])
def test_planes_slide_into_the_bounds_as_one_by_one(geometry, tx_mm):
    outside = drawn(2) + torch.tensor([0.0, 0.0, tx_mm, 0.0])
    assert ((outside[:, 2] < 0.0) | (outside[:, 2] > 97.2)).sum() > 50
    # Through the middle of its slice.
    found = geometry.through(geometry.normals(outside), geometry.middles(outside))
    for plane, shifted in zip(one_by_one(outside), found.numpy(), strict=True):
        expected = shift_into(plane, BOUNDS.translation_mm)
        distance = plane_distance(ManipulatorAction.from_array(shifted), expected, MIDDLE)
        assert distance == pytest.approx((0.0, 0.0), abs=1e-4)
        assert 0.0 <= shifted[2] <= 97.2

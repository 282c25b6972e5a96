"""The search for the optimal plane of a volume that has none."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.anatomy import TissueClusters, find_optimal_plane, landmark_reward
from armscan.anatomy.plane_search import PlaneGrid, largest_best_region, plane_at
from armscan.errors import InvalidValueError, OptimalPlaneError
from armscan.volumes import load_phantom, plane_distance, read_dataset

QUICK = {"rx_deg": 10.0, "step_deg": 10.0, "step_mm": 6.0}


def distance(volume, action):
    return plane_distance(action, volume.optimal_action, (volume.centre_mm[0], volume.centre_mm[2]))


@pytest.mark.parametrize("seed", [0, 3, 18])
def test_find_optimal_plane_lands_near_the_plane_of_a_phantom(seed):
    phantom = load_phantom(seed)
    found = find_optimal_plane(replace(phantom, optimal_action=None), **QUICK)
    offset_mm, angle_deg = distance(phantom, found.action)
    assert offset_mm < 3.0
    assert angle_deg < 6.0
    assert found.score == 0.0
    assert found.counts == (4, 3, 1)
    # As good planes lie at the limit of 10 degrees about X.
    assert found.is_cut


def test_find_optimal_plane_scores_what_its_plane_shows_within_the_bounds(phantom):
    found = find_optimal_plane(phantom, **QUICK)
    assert found.score == landmark_reward(TissueClusters.from_slice(phantom.slice(found.action)))
    assert all(0 <= t <= n for t, n in zip(found.action.translation, phantom.size_mm[:2], strict=True))
    assert abs(found.action.rotation[0]) <= 45.0
    assert abs(found.action.rotation[1]) <= 10.0


def test_find_optimal_plane_looks_at_no_label_and_draws_nothing(phantom):
    assert find_optimal_plane(phantom, **QUICK) == find_optimal_plane(replace(phantom, optimal_action=None), **QUICK)


@pytest.mark.slow
def test_find_optimal_plane_finds_each_labelled_plane(dataset, more_volumes):
    for volume in (*dataset.values(), *read_dataset(more_volumes).values()):
        found = find_optimal_plane(replace(volume, optimal_action=None))
        offset_mm, angle_deg = distance(volume, found.action)
        assert (offset_mm <= 6.0, angle_deg <= 12.0) == (True, True), volume.name
        assert found.score > -0.05


def test_find_optimal_plane_names_the_volume_that_shows_no_landmarks(tiny_volume):
    with pytest.raises(
        OptimalPlaneError, match=r"tiny: no plane of \d+ scores above -success_threshold = -0.05; .* is -\d\.\d+"
    ):
        find_optimal_plane(tiny_volume)


@pytest.mark.parametrize(
    "bad",
    [
        {"rz_deg": 81.0},
        {"rx_deg": -1.0},
        {"step_deg": 0.0},
        {"step_mm": float("nan")},
        {"success_threshold": 0.0},
        {"targets": (4, 3)},
    ],
)
def test_find_optimal_plane_refuses_values_out_of_bounds(tiny_volume, bad):
    with pytest.raises(InvalidValueError, match=next(iter(bad))):
        find_optimal_plane(tiny_volume, **bad)


def test_find_optimal_plane_refuses_what_is_no_volume_and_what_takes_days(tiny_volume):
    with pytest.raises(InvalidValueError, match="must be a LabelVolume"):
        find_optimal_plane(tiny_volume.labels)
    with pytest.raises(InvalidValueError, match="at most 1000000 are allowed"):
        find_optimal_plane(tiny_volume, step_mm=1e-6)


def test_largest_best_region_is_connected_and_best():
    rewards = np.full((6, 6, 6), -1.0)
    rewards[0, 0, :] = -0.5
    rewards[2, 2, 2:4] = 0.0
    rewards[3, 3, 4] = 0.0
    rewards[5, 0, 0:2] = 0.0
    assert largest_best_region(rewards).tolist() == [[2, 2, 2], [2, 2, 3], [3, 3, 4]]


def test_plane_grid_is_scored_again_about_a_region_at_half_the_steps():
    coarse = PlaneGrid.between(np.array([-10.0, -5.0, 0.0]), np.array([10.0, 5.0, 30.0]), np.array([5.0, 5.0, 3.0]))
    assert coarse.shape == (5, 3, 11)
    fine = coarse.finer_about(np.array([[0, 1, 4], [1, 1, 5]]))
    assert fine.shape == (5, 5, 7)
    assert fine.lowest.tolist() == [-10.0, -5.0, 9.0]
    assert fine.pose(np.array([4, 4, 6])).tolist() == [0.0, 5.0, 18.0]


@pytest.mark.parametrize("pose", [(0.0, 0.0, 100.0), (20.0, 0.0, 100.0), (-30.0, 15.0, 80.0)])
def test_plane_at_a_pose_has_the_middle_of_its_slice_there(phantom, pose):
    plane = plane_at(phantom, np.array(pose))
    slice_centre_mm = plane.matrix @ [phantom.centre_mm[0], 0.0, phantom.centre_mm[2]] + plane.offset_mm
    assert plane.rotation == pose[:2]
    assert slice_centre_mm[:2] == pytest.approx([phantom.centre_mm[0], pose[2]])


def test_plane_at_a_pose_that_no_action_in_the_volume_has_is_none(tiny_volume):
    assert plane_at(tiny_volume, np.array([0.0, 45.0, 0.0])) is not None
    assert plane_at(tiny_volume, np.array([0.0, -45.0, 0.0])) is None

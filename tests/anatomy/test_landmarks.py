"""The landmark reward."""

import numpy as np
import pytest

from armscan.anatomy import Clusters, Tissue, TissueClusters, landmark_reward
from armscan.errors import InvalidValueError


def seen(bones, tendons, artery):
    """Clusters whose centres lie at the given depths."""

    def tissue(depths):
        centres = np.array([[10.0 * i, depth] for i, depth in enumerate(depths)]).reshape(-1, 2)
        return Clusters(np.zeros((4, 4), np.int32), centres, np.full(len(depths), 9))

    return TissueClusters(tissue(bones), tissue(tendons), tissue(artery))


def test_landmark_reward_reproduces_every_golden_reward_to_the_last_bit(golden):
    rewards = [landmark_reward(TissueClusters.from_slice(golden[f"s{row}"])) for row in range(len(golden["reward"]))]
    np.testing.assert_array_equal(rewards, golden["reward"])


@pytest.mark.parametrize(
    ("clusters", "reward"),
    [
        (seen([1, 2, 3, 4], [6, 7, 8], [9]), 0.0),
        (seen([9, 9, 9, 9], [6, 7, 8], [1]), 0.0),
        (seen([1, 2, 3], [6, 7, 8], [9]), -1 / 24),
        (seen([1, 2, 3, 4, 5], [6, 7], [9]), -2 / 24),
        (seen([], [], []), -1.0),
        # The artery is missing: one count off, one tissue of three missing, and no order to be seen.
        (seen([1, 2, 3, 4], [6, 7, 8], []), -(1 / 8 + 1 / 3 + 1) / 3),
        # Two arteries, or the tendons not strictly between: only the order is wrong beside the count.
        (seen([1, 2, 3, 4], [6, 7, 8], [9, 9]), -(1 / 8 + 1) / 3),
        (seen([1, 2, 3, 4], [6, 7, 8], [5]), -1 / 3),
        (seen([1, 2, 3, 4], [6, 7, 8], [7]), -1 / 3),
    ],
)
def test_landmark_reward_adds_up_its_terms(clusters, reward):
    assert landmark_reward(clusters) == pytest.approx(reward)


def test_landmark_reward_means_over_centres_not_pixels():
    bones = Clusters(np.zeros((4, 4), np.int32), np.array([[0.0, 1.0], [0.0, 9.0]]), np.array([1000, 1]))
    others = seen([], [7, 7, 7], [8])
    assert landmark_reward(TissueClusters(bones, others.tendons, others.artery)) == pytest.approx(-2 / 24)


def test_landmark_reward_is_never_below_minus_one():
    assert landmark_reward(seen(range(90), range(90), [])) == -1.0


def test_landmark_reward_takes_other_targets():
    assert landmark_reward(seen([1] * 7, [5] * 5, [9]), targets=(7, 5, 1)) == 0.0


@pytest.mark.parametrize("targets", [(4, 3), (4, 3, 0), (4, 3, 1.5), "abc", (4, 3, 1, 1)])
def test_landmark_reward_refuses_impossible_targets(targets):
    with pytest.raises(InvalidValueError, match="targets"):
        landmark_reward(seen([1], [1], [1]), targets)


@pytest.mark.parametrize("slice_xz", [np.zeros((3, 3, 3), int), np.zeros((3, 3)), np.zeros(3, int)])
def test_tissue_clusters_refuse_what_is_no_slice_of_labels(slice_xz):
    with pytest.raises(InvalidValueError, match="the slice is an array of shape"):
        TissueClusters.from_slice(slice_xz)


def test_tissue_clusters_of_an_empty_slice_are_none():
    clusters = TissueClusters.from_slice(np.zeros((5, 6), np.uint8))
    assert clusters.counts == (0, 0, 0)
    np.testing.assert_array_equal(clusters.bones.mean_centre, [0, 0])


@pytest.mark.parametrize(("eps_px", "min_samples"), [(0.0, 4), (-1.0, 4), (float("nan"), 4), (1.0, 0), (1.0, 2.5)])
def test_tissue_refuses_impossible_clustering(eps_px, min_samples):
    with pytest.raises(InvalidValueError, match="bones: "):
        Tissue("bones", 1, eps_px, min_samples, 100.0)

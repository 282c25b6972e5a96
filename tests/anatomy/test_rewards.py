"""Rewards of slices."""

import numpy as np
import pytest

from armscan.anatomy import AgreementReward, Clusters, LandmarkReward, TissueClusters, landmark_reward
from armscan.errors import InvalidValueError, OptimalPlaneError
from armscan.volumes import LabelVolume, ManipulatorAction


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
        (seen([7] * 4, [6, 7, 8], [9]), -1 / 3),
        (seen([7] * 4, [6, 7, 8], [5]), -1 / 3),
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


@pytest.fixture(scope="module")
def agreement(dataset):
    return AgreementReward().fit(dataset.values())


def score(reward, volume, action):
    clusters = TissueClusters.from_slice(volume.slice(action), pixel_mm=volume.pixel_mm)
    return reward.score(clusters.landmarks, volume.pixel_mm)


def moved(action, *, mm=0.0, deg=0.0):
    (rz, rx), (tx, ty) = action.rotation, action.translation
    return ManipulatorAction((rz + deg, rx), (tx, ty + mm))


def test_agreement_reward_is_zero_at_every_labelled_plane(agreement, dataset):
    assert [score(agreement, volume, volume.optimal_action) for volume in dataset.values()] == [0.0] * len(dataset)


def test_agreement_reward_falls_where_the_published_one_stays_zero(agreement, dataset):
    published = LandmarkReward()
    satisfied = [
        (score(published, volume, plane), score(agreement, volume, plane))
        for volume in dataset.values()
        for mm in np.arange(-15.0, 15.0, 1.0)
        for plane in [moved(volume.optimal_action, mm=mm)]
        if score(published, volume, plane) == 0.0
    ]
    assert min(found for _, found in satisfied) < -0.05
    assert all(-1.0 <= found <= 0.0 for _, found in satisfied)


def test_agreement_reward_costs_what_features_differ_from_the_labelled_planes():
    labels = np.zeros((60, 1, 40), dtype=np.uint8)
    labels[10:30, :, 4:20], labels[36:44, :, 24:32], labels[4:8, :, 34:38] = 1, 2, 3
    volume = LabelVolume(labels, (0.5, 1.0, 0.25), "blocks", ManipulatorAction((0, 0), (0, 0)))
    reward = AgreementReward().fit([volume])
    bones, tendons, artery = TissueClusters.from_slice(volume.slice(volume.optimal_action)).landmarks[:, 1]
    # Areas are free within 10 % and cost 1 at 50 % further; distances are free within 0.5 mm of 10, 4, 7 and 6 mm and
    # cost 1 at 5 mm further. Counts and order are right, on both sides of the bones.
    costs = [0.15 / 0.5, 0.15 / 0.5, 0.0, 1.5 / 5, 0.5 / 5, 3.5 / 5, 3.5 / 5]
    for side in (-1, 1):
        landmarks = np.array(
            [
                [4, 0.75 * bones, 33, 17],
                [3, 1.25 * tendons, 33 + 24 * side, 29],
                [1, 0.92 * artery, 33 - 6 * side, 57],
            ]
        )
        assert reward.score(landmarks, volume.pixel_mm) == pytest.approx(-0.5 * sum(costs) / 7)
    # Without bones, their area and all distances cost 1.
    landmarks = np.array([[0, 0, 0, 0], [3, tendons, 24, 28], [1, artery, 36, 36]])
    published = (4 / 8 + 1 / 3 + 1) / 3
    assert reward.score(landmarks, volume.pixel_mm) == pytest.approx(-0.5 * (published + 5 / 7))


def test_agreement_reward_is_minus_one_where_nothing_is_seen(agreement):
    assert agreement.score(np.zeros((3, 4)), (0.27, 0.55)) == -1.0


def test_agreement_reward_needs_labelled_planes_that_show_every_tissue(dataset):
    volume = next(iter(dataset.values()))
    unlabelled = LabelVolume(volume.labels, volume.spacing, "unlabelled")
    elsewhere = LabelVolume(volume.labels, volume.spacing, "elsewhere", ManipulatorAction((0, 0), (0, 5000)))
    with pytest.raises(OptimalPlaneError, match="unlabelled: has no labelled plane"):
        AgreementReward().fit([unlabelled])
    with pytest.raises(OptimalPlaneError, match=r"elsewhere: the labelled plane shows \(0, 0, 0\)"):
        AgreementReward().fit([elsewhere])
    with pytest.raises(InvalidValueError, match="volumes is empty"):
        AgreementReward().fit([])
    with pytest.raises(InvalidValueError, match=r"call fit\("):
        AgreementReward().score(np.zeros((3, 4)), (0.27, 0.55))


@pytest.mark.parametrize("bad", [{"area_tolerance": 0}, {"distance_tolerance_mm": -1}, {"slack": 2}, {"slack_mm": "a"}])
def test_agreement_reward_refuses_impossible_tolerances(bad):
    with pytest.raises(InvalidValueError, match=next(iter(bad))):
        AgreementReward(**bad)

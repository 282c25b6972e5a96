"""Phantom wrists: their anatomy, their optimal plane, their cache."""

import numpy as np
import pytest

from armscan.anatomy import TissueClusters, landmark_reward
from armscan.errors import InvalidValueError
from armscan.volumes import ManipulatorAction, load_phantom, make_phantom
from armscan.volumes.phantom import cache
from armscan.volumes.phantom.generate import Pose
from armscan.volumes.phantom.wrist import draw_wrist

SEEDS = (0, 1, 2, 3, 50, 51)


@pytest.fixture(scope="module", params=SEEDS)
def wrist(request):
    return load_phantom(request.param)


def rewards_along_the_arm(volume, step_mm=1.0):
    rotation, (tx, _) = volume.optimal_action.rotation, volume.optimal_action.translation
    positions = np.arange(0.0, volume.size_mm[1], step_mm)
    planes = (ManipulatorAction(rotation, (tx, ty)) for ty in positions)
    return positions, np.array([landmark_reward(TissueClusters.from_slice(volume.slice(p))) for p in planes])


def test_phantom_optimal_plane_is_rewarded(wrist):
    clusters = TissueClusters.from_slice(wrist.slice(wrist.optimal_action))
    assert landmark_reward(clusters) > -0.05


def test_phantom_is_rewarded_in_a_narrow_band_about_its_plane(wrist):
    positions, rewards = rewards_along_the_arm(wrist)
    rewarded = rewards > -0.05
    assert 0.06 < rewarded.mean() < 0.12
    assert np.abs(positions[rewarded] - wrist.optimal_action.translation[1]).max() < 16
    assert rewards[~rewarded].max() <= -0.08


def test_phantom_has_every_tissue_and_stray_voxels(wrist):
    from scipy import ndimage

    counts = np.bincount(wrist.labels.ravel(), minlength=5)
    assert (counts[1:] > 5000).all()
    bones, n_bones = ndimage.label(wrist.labels == 1)
    assert (np.bincount(bones.ravel()) == 1).sum() > 20
    assert n_bones > 20


def test_phantom_has_one_tendon_to_each_finger(wrist):
    action = wrist.optimal_action
    beyond = ManipulatorAction(action.rotation, (0.0, action.translation[1] - 30.0))
    assert len(TissueClusters.from_slice(wrist.slice(beyond)).tendons) in (4, 5)


def test_phantoms_are_left_and_right_hands_and_lie_differently():
    poses = [Pose.draw(np.random.default_rng(seed)) for seed in range(40)]
    assert {pose.left for pose in poses} == {True, False}
    assert np.ptp([pose.rotation[0] for pose in poses]) > 15
    assert np.ptp([pose.origin_mm[1] for pose in poses]) > 40


def test_wrist_has_the_bones_of_a_hand():
    tubes = draw_wrist(np.random.default_rng(0))
    labels = [tube.label for tube in tubes]
    # Radius, ulna and their styloids; 8 carpals and the hook; 5 metacarpals, 9 phalanges; 8 accessory bones.
    assert labels.count(1) == 4 + 9 + 14 + 8
    assert labels.count(2) == 5
    assert labels.count(3) == labels.count(4) == 1


def test_phantom_of_a_seed_is_always_the_same():
    first, second = make_phantom(7), make_phantom(7)
    np.testing.assert_array_equal(first.labels, second.labels)
    assert first.optimal_action == second.optimal_action
    assert (make_phantom(8).labels != first.labels).any()


@pytest.mark.parametrize("seed", [-1, 1.5, "a", None, True])
def test_phantom_refuses_a_seed_that_is_no_whole_number(seed):
    with pytest.raises(InvalidValueError, match="seed is"):
        make_phantom(seed)


def test_cached_phantom_equals_a_new_one_and_is_not_made_again(tmp_path, monkeypatch):
    made = load_phantom(3, tmp_path)
    monkeypatch.setattr(cache.generate, "make_phantom", None)
    assert load_phantom(3, tmp_path) is made
    cache._IN_MEMORY.clear()
    cached = load_phantom(3, tmp_path)
    np.testing.assert_array_equal(cached.labels, made.labels)
    assert cached.optimal_action == made.optimal_action
    assert (cached.spacing, cached.name) == (made.spacing, made.name)


def test_damaged_cache_is_replaced(tmp_path):
    made = load_phantom(3, tmp_path)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:5000])
    cache._IN_MEMORY.clear()
    np.testing.assert_array_equal(load_phantom(3, tmp_path).labels, made.labels)
    with np.load(file) as kept:
        np.testing.assert_array_equal(kept["labels"], made.labels)


@pytest.mark.slow
@pytest.mark.parametrize(("projection", "at_least"), [("y", 11.0), ("zy", 21.0), ("full", 25.0)])
def test_random_policy_needs_many_steps_on_phantoms(projection, at_least):
    from armscan.envs import ArmscanEnv
    from armscan.volumes import load_phantoms

    env = ArmscanEnv(load_phantoms(range(24)), projection=projection, rotation_bounds_deg=(90.0, 45.0))
    env.action_space.seed(0)
    n_steps, n_episodes = 0, 800
    for episode in range(n_episodes):
        env.reset(seed=episode)
        ended = False
        while not ended:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            n_steps += 1
            ended = terminated or truncated
    assert n_steps / n_episodes > at_least

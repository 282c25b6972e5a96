"""Phantom wrists: their anatomy, their optimal plane, their cache."""

import numpy as np
import pytest

from armscan.anatomy import TissueClusters, landmark_reward
from armscan.errors import InvalidValueError
from armscan.volumes import ManipulatorAction, load_phantom, load_phantoms, make_phantom
from armscan.volumes.phantom import cache
from armscan.volumes.phantom.generate import VERSIONS, Pose
from armscan.volumes.phantom.tube import RADIUS_X, Tube, Y
from armscan.volumes.phantom.varied import draw_varied_wrist
from armscan.volumes.phantom.wrist import draw_wrist

SEEDS = (0, 1, 2, 3, 50, 51)
# Voxels of each label of the phantom with seed 7, version 1.
KNOWN_COUNTS = [20787918, 1620651, 564261, 42511, 24659]


@pytest.fixture(scope="module", params=SEEDS)
def wrist(request):
    return load_phantom(request.param)


@pytest.fixture(scope="module", params=VERSIONS)
def version(request):
    return request.param


def ends_of_rows(draw, seed):
    """Return where the distal row ends and the next bones begin, in mm along the arm from the labelled plane."""
    bones = [tube for tube in draw(np.random.default_rng(seed)) if tube.label == 1]
    spans = [(tube.nodes[0, Y], tube.nodes[-1, Y]) for tube in bones]
    return max(high for low, high in spans if low < 0 < high), min(low for low, _ in spans if low > 0)


def rewards_along_the_arm(volume):
    rotation, (tx, _) = volume.optimal_action.rotation, volume.optimal_action.translation
    positions = np.arange(0.0, volume.size_mm[1])
    planes = (ManipulatorAction(rotation, (tx, ty)) for ty in positions)
    return positions, np.array([landmark_reward(TissueClusters.from_slice(volume.slice(p))) for p in planes])


def test_phantom_optimal_plane_is_rewarded(wrist):
    clusters = TissueClusters.from_slice(wrist.slice(wrist.optimal_action))
    assert landmark_reward(clusters) > -0.05


def test_phantom_of_version_2_is_rewarded_and_of_both_hands():
    are_left = []
    for seed in range(12):
        volume = load_phantom(seed, version=2)
        clusters = TissueClusters.from_slice(volume.slice(volume.optimal_action))
        assert landmark_reward(clusters) > -0.05
        assert set(np.unique(volume.labels)) == {0, 1, 2, 3, 4}
        # The artery runs along the side of the little finger.
        are_left.append(clusters.artery.mean_centre[0] < clusters.tendons.mean_centre[0])
    assert are_left == [Pose.draw(np.random.default_rng(seed)).left for seed in range(12)]
    assert set(are_left) == {True, False}


def test_phantoms_of_version_2_differ_in_where_the_labelled_plane_cuts_the_carpus():
    usual = np.array([ends_of_rows(draw_wrist, seed) for seed in range(60)])
    varied = np.array([ends_of_rows(draw_varied_wrist, seed) for seed in range(60)])
    assert (np.ptp(usual, axis=0) < 4.0).all()
    assert (np.ptp(varied, axis=0) > 8.0).all()
    # Some rows end nearer to the plane than any in version 1, others about where they do there; some rows overlap.
    assert varied[:, 0].min() < usual[:, 0].min() - 4.0
    assert varied[:, 0].max() > usual[:, 0].min()
    assert (varied[:, 1] < varied[:, 0]).any()


def test_tendons_of_version_2_are_in_three_groups_on_both_sides_of_the_plane():
    n_pieces = set()
    for seed in range(20):
        tendons = [tube for tube in draw_varied_wrist(np.random.default_rng(seed)) if tube.label == 2]
        inside = [tube for tube in tendons if tube.nodes[0, Y] < 0 < tube.nodes[-1, Y]]
        assert len(inside) == 5
        ends = np.array([(tube.nodes[0, Y], tube.nodes[-1, Y]) for tube in inside])
        assert (np.abs(ends) > 7.0).all()
        np.testing.assert_allclose(ends.sum(axis=1), 0.0, atol=1e-9)
        # If a piece is missing, there is a gap after the end of the groups.
        n_pieces.add(min(tube.nodes[0, Y] for tube in tendons if tube.nodes[0, Y] > 0) - ends[0, 1] > 0.3)
    assert n_pieces == {True, False}


def test_phantoms_of_version_1_are_what_they_always_were():
    counts = np.bincount(make_phantom(7).labels.ravel(), minlength=5)
    np.testing.assert_allclose(counts, KNOWN_COUNTS, atol=20)


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


def test_phantom_of_a_seed_is_always_the_same(version):
    first, second = make_phantom(7, version), make_phantom(7, version)
    np.testing.assert_array_equal(first.labels, second.labels)
    assert first.optimal_action == second.optimal_action
    assert (make_phantom(8, version).labels != first.labels).any()


def test_versions_have_names_and_files_of_their_own(tmp_path):
    made = [load_phantom(7, tmp_path, each) for each in VERSIONS]
    assert [volume.name for volume in made] == ["phantom-7", "phantom-v2-7"]
    assert len(list(tmp_path.glob("*.volume"))) == 2
    cache._IN_MEMORY.clear()
    for volume, each in zip(made, VERSIONS, strict=True):
        again = load_phantom(7, tmp_path, each)
        np.testing.assert_array_equal(again.labels, volume.labels)
        assert again.name == volume.name


def test_phantom_refuses_a_version_that_there_is_not():
    with pytest.raises(InvalidValueError, match="version is 3, but it must be 1 or 2"):
        make_phantom(7, 3)


def test_part_of_a_tube_is_cut_where_it_is_told_to():
    tube = Tube(1, np.array([[0.0, 1.0, 2.0, 3.0, 4.0], [10.0, 2.0, 2.0, 5.0, 4.0], [20.0, 2.0, 2.0, 1.0, 4.0]]))
    part = tube.between(5.0, 15.0)
    np.testing.assert_allclose(part.nodes[:, Y], [5.0, 10.0, 15.0])
    np.testing.assert_allclose(part.nodes[:, RADIUS_X], [4.0, 5.0, 3.0])
    np.testing.assert_array_equal(tube.between(-9.0, 99.0).nodes, tube.nodes)


def test_arranged_tube_is_stretched_then_moved_and_grows_thicker():
    tube = Tube(1, np.array([[10.0, 1.0, 2.0, 3.0, 4.0]]))
    arranged = tube.arrange(shift_mm=(0.5, -2.0, 1.0), stretch=(2.0, 0.5, 1.0), thickness=(1.5, 2.0))
    np.testing.assert_allclose(arranged.nodes, [[3.0, 2.5, 3.0, 4.5, 8.0]])


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
    (file,) = tmp_path.glob("*.volume")
    sound = file.read_bytes()
    file.unlink()
    file.write_bytes(sound[:5000])
    cache._IN_MEMORY.clear()
    np.testing.assert_array_equal(load_phantom(3, tmp_path).labels, made.labels)
    assert file.read_bytes() == sound


def test_phantoms_at_once_are_those_one_by_one_also_where_some_are_there(tmp_path):
    load_phantom(4, tmp_path)
    cache._IN_MEMORY.clear()
    several = load_phantoms([3, 4], tmp_path)
    assert list(several) == ["phantom-3", "phantom-4"]
    for seed, volume in zip([3, 4], several.values(), strict=True):
        assert volume is load_phantom(seed, tmp_path)
        np.testing.assert_array_equal(volume.labels, make_phantom(seed).labels)


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

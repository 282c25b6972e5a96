"""Observations."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from armscan.anatomy import PIXEL_TISSUES
from armscan.envs import (
    ArmscanEnv,
    ArmscanVectorEnv,
    ClusterObservation,
    MergedObservation,
    SliceGeometry,
    SliceObservation,
    View,
)
from armscan.envs.observation_registry import with_action_reward
from armscan.envs.spaces import flat_space, flatten
from armscan.errors import InvalidValueError

GEOMETRY = SliceGeometry((361, 81), (0.27, 0.55))


def view_of(bones, tendons, artery, geometry=GEOMETRY):
    """Return a view of clusters given as lists of (across, depth, pixels)."""

    def summary(rows):
        table = np.array(rows, dtype=float).reshape(-1, 3)
        centre = table[:, :2].mean(axis=0) if len(table) else (0.0, 0.0)
        return [len(table), table[:, 2].sum(), *centre]

    return View(
        slice_xz=np.zeros(geometry.shape, np.uint8),
        landmarks=np.array([summary(tissue) for tissue in (bones, tendons, artery)]),
        tissues=PIXEL_TISSUES,
        geometry=geometry,
        smallest_shape=geometry.shape,
        action=np.array([0.25]),
        reward=-0.5,
    )


def test_cluster_observation_normalises_counts_sizes_and_centres():
    view = view_of([(180, 40, 1000), (200, 50, 500)], [(180, 40, 250)], [])
    features = ClusterObservation().observe(view)["clusters"].reshape(3, 4)
    np.testing.assert_allclose(features[0], [2 / 4, 0.5, 10 * 0.27 / 25, 5 * 0.55 / 12], rtol=1e-6)
    np.testing.assert_allclose(features[1], [1 / 3, 0.25, 0, 0], rtol=1e-6)
    np.testing.assert_array_equal(features[2], 0)


def test_cluster_observation_scales_sizes_by_pixel_area():
    coarse = SliceGeometry((100, 40), (0.54, 1.1))
    features = ClusterObservation().observe(view_of([(50, 20, 750)], [], [], coarse))["clusters"]
    assert features[1] == pytest.approx(1.0)


def test_cluster_observation_comes_raw_as_published():
    view = view_of([(180, 40, 1000), (200, 50, 500)], [(7, 8, 9)], [])
    features = ClusterObservation(normalised=False).observe(view)["clusters"]
    np.testing.assert_array_equal(features, [2, 1500, 190, 45, 1, 9, 7, 8, 0, 0, 0, 0])


@pytest.mark.parametrize("normalised", [True, False])
def test_cluster_observation_space_holds_the_extremes_of_every_geometry(normalised):
    other = SliceGeometry((50, 200), (1.0, 0.1))
    observation = ClusterObservation(normalised=normalised)
    space = observation.spaces([GEOMETRY, other], 1)["clusters"]
    for geometry in (GEOMETRY, other):
        for corner in ((0, 0), (geometry.shape[0] - 1, geometry.shape[1] - 1)):
            view = view_of(*[[(*corner, geometry.shape[0] * geometry.shape[1])]] * 3, geometry)
            assert space.contains(observation.observe(view)["clusters"])


def test_flat_space_has_its_bounds_in_the_order_of_the_data():
    observation = with_action_reward("cluster")
    space = flat_space(observation.spaces([GEOMETRY], 1))
    flat = flatten(observation.observe(view_of([], [], [])))
    np.testing.assert_array_equal(flat[-2:], [0.25, -0.5])
    np.testing.assert_array_equal(space.low[-2:], [-1, -1])
    np.testing.assert_array_equal(space.high[-2:], [1, 0])
    assert space.contains(flat)


@pytest.mark.parametrize("normalised", ["no", None, 3])
def test_cluster_observation_refuses_what_is_no_truth_value(normalised):
    with pytest.raises(InvalidValueError, match=r"normalised is .* true or false"):
        ClusterObservation(normalised=normalised)


def test_with_action_reward_names_what_there_is():
    with pytest.raises(
        InvalidValueError,
        match="observation is 'slices', but it must be action_reward, cluster, slice, slice_channels or slice_metric",
    ):
        with_action_reward("slices")


@pytest.mark.parametrize(
    "observation",
    [
        ["cluster", "slice"],
        ("cluster", SliceObservation()),
        MergedObservation(["cluster", "slice"]),
        MergedObservation([ClusterObservation(), MergedObservation([SliceObservation()])]),
        ["cluster", "slice", "action_reward"],
        [["cluster", "action_reward"], "slice"],
    ],
    ids=["names", "tuple", "object", "nested", "with_action_reward", "nested_names"],
)
def test_merged_observations_come_by_name_in_a_list_or_as_objects(wrist, observation):
    env = ArmscanEnv([wrist], observation=observation)
    observed, info = env.reset(seed=0)
    assert observed.keys() == {"clusters", "slice", "action", "reward"} == set(env.observation_space)
    np.testing.assert_array_equal(observed["slice"], env.slice_xz)
    np.testing.assert_allclose(observed["clusters"].reshape(3, 4)[:, 0] * (4, 3, 1), info["counts"], rtol=1e-6)
    np.testing.assert_array_equal(observed["action"], info["action"])


def test_merged_observations_become_one_vector_in_their_order(wrist):
    parts = ArmscanEnv([wrist], observation=["slice", "cluster"])
    flat = ArmscanEnv([wrist], observation=["slice", "cluster"], flat=True)
    observed, _ = parts.reset(seed=0)
    expected = [observed[name].ravel() for name in ("slice", "clusters", "action", "reward")]
    np.testing.assert_array_equal(flat.reset(seed=0)[0], np.concatenate(expected))


@pytest.mark.parametrize(
    ("observation", "keys"),
    [
        (["slice", "slice"], "slice"),
        (["action_reward", "cluster", "cluster"], "clusters"),
        (["action_reward", "action_reward"], "action or reward"),
    ],
    ids=str,
)
def test_env_refuses_two_parts_of_one_name(wrist, observation, keys):
    with pytest.raises(InvalidValueError, match=f"both have the key {keys}$"):
        ArmscanEnv([wrist], observation=observation)


class DepthProfile:
    """A user's own observation: which share of each depth is tissue."""

    def spaces(self, geometries, n_action):
        return {"profile": gym.spaces.Box(0, 1, (min(g.shape[1] for g in geometries),), np.float32)}

    def observe(self, view):
        return {"profile": (view.slice_xz > 0).mean(axis=0, dtype=np.float32)[: view.smallest_shape[1]]}


@pytest.mark.parametrize("observation", [DepthProfile(), ["cluster", DepthProfile()]], ids=["alone", "merged"])
def test_env_takes_a_users_own_observation(wrist, observation):
    env = ArmscanEnv([wrist], observation=observation, flat=False)
    observed, _ = env.reset(seed=0)
    assert env.observation_space.contains(observed)
    np.testing.assert_allclose(observed["profile"], (env.slice_xz > 0).mean(axis=0), rtol=1e-6)
    assert {"action", "reward"} < observed.keys()


class Careless:
    """A user's own observation that returns other parts than its spaces have."""

    def __init__(self, parts):
        self.parts = parts

    def spaces(self, geometries, n_action):
        return {"a": spaces.Box(0, 1, (1,), np.float32), "b": spaces.Box(100, 200, (2,), np.float32)}

    def observe(self, view):
        return {name: np.array(values, dtype=np.float32) for name, values in self.parts.items()}


def test_own_observation_may_give_its_parts_in_any_order(phantom):
    for make in (lambda e: e, lambda e: ArmscanVectorEnv(2, [phantom], observation=e.rules._observation)):
        env = make(ArmscanEnv([phantom], observation=Careless({"b": [150, 160], "a": [0.5]})))
        observed, _ = env.reset(seed=0)
        assert env.observation_space.contains(observed)
        np.testing.assert_array_equal(np.atleast_2d(observed)[0, :3], [0.5, 150, 160])


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"a": [0.5]}, "gave the parts a, action, reward, but its spaces are of a, b, action, reward"),
        ({"a": [0.5], "b": [150, 160], "c": [1]}, "gave the parts a, b, c, action, reward"),
        ({"a": [0.5], "b": [150]}, r"gave b of shape \(1,\), but its space has shape \(2,\)"),
    ],
)
def test_own_observation_that_gives_other_parts_is_refused(phantom, parts, message, flat):
    env = ArmscanEnv([phantom], observation=Careless(parts), flat=flat)
    with pytest.raises(InvalidValueError, match=message):
        env.reset(seed=0)


@pytest.mark.parametrize("n_envs", [None, 2])
@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (None, "Other.observe returned .*None.*, but it must return an array for each part"),
        ({"a": np.float32([np.nan]), "b": np.uint8([7])}, r"Other.observe gave .*nan.* as a, but its space is Box\(0"),
        ({"a": np.float32([1.5]), "b": np.uint8([7])}, r"gave .*1\.5.* as a, but its space is Box\(0"),
        ({"a": np.float32([0.5]), "b": np.array([7.7])}, r"gave .*7\.7.* as b, but its space is Box\(0, 255"),
    ],
)
def test_own_observation_outside_of_its_space_is_refused(phantom, parts, message, n_envs):
    class Other:
        def spaces(self, geometries, n_action):
            return {"a": spaces.Box(0, 1, (1,), np.float32), "b": spaces.Box(0, 255, (1,), np.uint8)}

        def observe(self, view):
            return parts

    make = ArmscanEnv if n_envs is None else partial(ArmscanVectorEnv, n_envs)
    with pytest.raises(InvalidValueError, match=message):
        make([phantom], observation=Other()).reset(seed=0)


def test_own_observation_whose_spaces_are_no_mapping_is_refused(phantom):
    class Other(Careless):
        def spaces(self, geometries, n_action):
            return spaces.Box(0, 1, (1,), np.float32)

    with pytest.raises(InvalidValueError, match=r"Other.spaces returned Box.*, but it must return a Box for each part"):
        ArmscanEnv([phantom], observation=Other({}))


def test_cluster_observation_by_name_divides_by_the_rewards_targets(phantom):
    env = ArmscanEnv([phantom], observation=["cluster"], targets=(7, 5, 1), success_threshold=0.9, projection="full")
    env.reset(seed=0)
    observed, *_, info = env.step(env.scene.optimum_normalised)
    np.testing.assert_allclose(observed[[0, 4, 8]], info["counts"] / (7, 5, 1), rtol=1e-6)

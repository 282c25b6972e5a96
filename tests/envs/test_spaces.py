"""Boxes by name, and one flat box."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector.utils import batch_space

from armscan.envs import MultiBoxSpace
from armscan.errors import InvalidValueError


def boxes():
    return {
        "slice": gym.spaces.Box(0, 4, (3, 2), np.uint8),
        "action": gym.spaces.Box(-1, 1, (2,), np.float32),
        "reward": gym.spaces.Box(-1, 0, (1,), np.float32),
    }


@pytest.fixture
def space():
    return MultiBoxSpace(boxes())


def test_multi_box_space_is_a_dict_of_boxes_that_knows_their_shapes(space):
    assert isinstance(space, gym.spaces.Dict)
    assert list(space) == ["action", "reward", "slice"]
    assert space.shape == [(2,), (1,), (3, 2)]
    assert space.shapes == {"action": (2,), "reward": (1,), "slice": (3, 2)}
    assert space.spaces == boxes()
    assert space["slice"].shape == (3, 2)


def test_multi_box_space_samples_and_contains(space):
    space.seed(0)
    sample = space.sample()
    assert space.contains(sample)
    assert sample["slice"].dtype == np.uint8
    assert not space.contains(sample | {"reward": np.array([0.5], np.float32)})
    assert not space.contains({"action": sample["action"]})


def test_multi_box_space_flattens_and_back(space):
    space.seed(0)
    sample = space.sample()
    flat = gym.spaces.flatten(space, sample)
    assert gym.spaces.flatten_space(space).shape == flat.shape == (9,)
    np.testing.assert_array_equal(flat[2:3], sample["reward"])
    back = gym.spaces.unflatten(space, flat)
    for name, part in sample.items():
        np.testing.assert_array_equal(back[name], part)


def test_multi_box_spaces_are_equal_where_their_boxes_are(space):
    assert space == MultiBoxSpace(boxes())
    assert space == gym.spaces.Dict(boxes())
    assert space != MultiBoxSpace(boxes() | {"reward": gym.spaces.Box(-2, 0, (1,), np.float32)})
    assert space != MultiBoxSpace({"action": boxes()["action"]})


def test_multi_box_space_is_the_same_after_pickling(space):
    space.seed(7)
    pickled = pickle.loads(pickle.dumps(space))
    assert isinstance(pickled, MultiBoxSpace)
    assert (pickled, pickled.shape) == (space, space.shape)
    np.testing.assert_equal(pickled.sample(), space.sample())


def test_multi_box_space_is_batched_as_a_dict(space):
    batched = batch_space(space, 5)
    assert {name: box.shape for name, box in batched.items()} == {
        "action": (5, 2),
        "reward": (5, 1),
        "slice": (5, 3, 2),
    }


@pytest.mark.parametrize("wrong", [{}, None, [], 3, {"a": 1}, {1: gym.spaces.Box(0, 1)}, {"a": gym.spaces.Discrete(2)}])
def test_multi_box_space_refuses_what_is_no_box_by_name(wrong):
    with pytest.raises(InvalidValueError, match="Box"):
        MultiBoxSpace(wrong)

"""Frame stack and best-action memory."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.wrappers import FlattenObservation, FrameStackObservation

from armscan.envs import ArmscanEnv, BestActionMemory, FrameStack, make_armscan_env
from armscan.errors import InvalidValueError


def test_stack_holds_the_last_observations_and_is_filled_with_the_first(phantom):
    bare, stacked = make_armscan_env([phantom]), make_armscan_env([phantom], stack=3)
    size = bare.observation_space.shape[0]
    first, _ = bare.reset(seed=1)
    observed, _ = stacked.reset(seed=1)
    np.testing.assert_array_equal(observed, np.tile(first, 3))
    latest = [first, first, first]
    for action in (-0.9, -0.5, 0.9):
        latest = [*latest[1:], bare.step(np.array([action]))[0]]
        observed = stacked.step(np.array([action]))[0]
        np.testing.assert_array_equal(observed.reshape(3, size), latest)


@pytest.mark.parametrize("observation", ["cluster", "slice"])
def test_stack_gives_what_gymnasiums_own_gives(phantom, observation):
    def bare():
        return ArmscanEnv([phantom], observation=observation, projection="zy", max_steps=5)

    ours, theirs = FrameStack(bare(), 3), FrameStackObservation(bare(), 3, padding_type="reset")
    theirs = FlattenObservation(theirs) if observation == "cluster" else theirs
    assert ours.observation_space == theirs.observation_space
    for seed in (0, 1):
        assert data_equivalence(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0], exact=True)
        for action in np.linspace(-1, -0.9, 5):
            assert data_equivalence(ours.step(np.full(2, action))[0], theirs.step(np.full(2, action))[0], exact=True)


class Scripted(gym.Env):
    """Gives the rewards it is told."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, rewards):
        self._rewards = iter(rewards)

    def _answer(self, action):
        self._reward = next(self._rewards)
        return np.zeros(2, np.float32), {"action": np.float32(action), "reward": self._reward}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._answer([0.0])

    def step(self, action):
        observed, info = self._answer(action)
        return observed, self._reward, False, False, info


def remembered(observed):
    return np.round(observed[2:].reshape(-1, 2).astype(float), 6).tolist()


def test_memory_keeps_the_best_pairs_best_first_and_the_earlier_of_equals():
    env = BestActionMemory(Scripted([-0.5, -0.75, -0.5, -0.25, -0.25, -0.5]), 3)
    observed, _ = env.reset()
    assert remembered(observed) == [[0.0, -0.5]] * 3
    # Worse than the worst kept, and as good as it: neither enters.
    assert remembered(env.step(np.array([0.1]))[0]) == [[0.0, -0.5]] * 3
    assert remembered(env.step(np.array([0.2]))[0]) == [[0.0, -0.5]] * 3
    assert remembered(env.step(np.array([0.3]))[0]) == [[0.3, -0.25], [0.0, -0.5], [0.0, -0.5]]
    assert remembered(env.step(np.array([0.4]))[0]) == [[0.3, -0.25], [0.4, -0.25], [0.0, -0.5]]
    assert remembered(env.step(np.array([0.5]))[0]) == [[0.3, -0.25], [0.4, -0.25], [0.0, -0.5]]


def test_memory_is_emptied_at_reset():
    env = BestActionMemory(Scripted([-0.5, -0.25, -0.75]), 2)
    env.reset()
    env.step(np.array([0.3]))
    assert remembered(env.reset()[0]) == [[0.0, -0.75]] * 2


def test_memory_follows_the_stack(phantom):
    env = make_armscan_env([phantom], projection="zy", stack=2, memory=3)
    assert env.observation_space.shape == (2 * 15 + 3 * 3,)
    observed, info = env.reset(seed=0)
    np.testing.assert_allclose(observed[-3:], [*info["action"], info["reward"]], rtol=1e-6)
    assert env.observation_space.contains(observed)


def test_memory_remembers_clipped_actions(phantom):
    env = make_armscan_env([phantom], memory=1)
    env.reset(seed=1)
    _, reward, *_ = env.step(np.array([5.0]))
    assert reward <= env.get_wrapper_attr("_best").pairs[0, 0, -1]
    assert np.abs(env.get_wrapper_attr("_best").pairs[0, :, :-1]).max() <= 1


@pytest.mark.parametrize("arguments", [{"stack": 0}, {"stack": 1.5}, {"memory": -1}, {"memory": "a"}])
def test_make_refuses_impossible_wrappers(phantom, arguments):
    with pytest.raises(InvalidValueError, match=f"{next(iter(arguments))} is"):
        make_armscan_env([phantom], **arguments)


def test_make_without_wrappers_gives_the_bare_environment(phantom):
    assert isinstance(make_armscan_env([phantom]), ArmscanEnv)

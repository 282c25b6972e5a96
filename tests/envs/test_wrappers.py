"""Frame stack and best-action memory."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation, FrameStackObservation

from armscan.envs import ArmscanEnv, BestActionMemory, FrameStack, SliceObservation, make_armscan_env
from armscan.envs.wrappers import VectorBestActionMemory, VectorFrameStack
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
    """An environment that gives the rewards it is told."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, rewards):
        self._rewards = iter(rewards)

    def _answer(self, action):
        self._reward = next(self._rewards)
        return np.zeros(2, np.float32), {"action": np.float32(action), "reward": self._reward}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._answer([0.0, 0.0])

    def step(self, action):
        observed, info = self._answer(action)
        return observed, self._reward, False, False, info


def best_pairs(observed):
    pairs = np.round(observed[2:].reshape(-1, 3).astype(float), 6)
    # The second component falls while the first one rises, so that neither orders the pairs.
    np.testing.assert_array_equal(pairs[:, 1], -pairs[:, 0])
    return pairs[:, [0, 2]].tolist()


def opposed(value):
    return np.array([value, -value])


def test_memory_keeps_the_best_pairs_best_first_and_the_earlier_of_equals():
    env = BestActionMemory(Scripted([-0.5, -0.75, -0.5, -0.25, -0.25, -0.5]), 3)
    observed, _ = env.reset()
    assert best_pairs(observed) == [[0.0, -0.5]] * 3
    # Worse than the worst kept, and as good as it: neither enters.
    assert best_pairs(env.step(opposed(0.1))[0]) == [[0.0, -0.5]] * 3
    assert best_pairs(env.step(opposed(0.2))[0]) == [[0.0, -0.5]] * 3
    assert best_pairs(env.step(opposed(0.3))[0]) == [[0.3, -0.25], [0.0, -0.5], [0.0, -0.5]]
    assert best_pairs(env.step(opposed(0.4))[0]) == [[0.3, -0.25], [0.4, -0.25], [0.0, -0.5]]
    assert best_pairs(env.step(opposed(0.5))[0]) == [[0.3, -0.25], [0.4, -0.25], [0.0, -0.5]]


def test_memory_is_emptied_at_reset():
    env = BestActionMemory(Scripted([-0.5, -0.25, -0.75]), 2)
    env.reset()
    env.step(opposed(0.3))
    assert best_pairs(env.reset()[0]) == [[0.0, -0.75]] * 2


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
    assert reward <= env.get_wrapper_attr("history").pairs[0, 0, -1]
    assert np.abs(env.get_wrapper_attr("history").pairs[0, :, :-1]).max() <= 1


@pytest.mark.parametrize("arguments", [{"stack": 0}, {"stack": 1.5}, {"memory": -1}, {"memory": "a"}])
def test_make_refuses_impossible_wrappers(phantom, arguments):
    with pytest.raises(InvalidValueError, match=f"{next(iter(arguments))} is"):
        make_armscan_env([phantom], **arguments)


def test_make_without_wrappers_gives_the_bare_environment(phantom):
    assert isinstance(make_armscan_env([phantom]), ArmscanEnv)


def image_env(wrist, **wrappers):
    """Return an environment with a Dict observation: a small image, action and reward."""
    observation = SliceObservation(shape=(24, 20))
    return make_armscan_env([wrist], observation=observation, projection="zy", max_steps=9, **wrappers)


def steps(env):
    """Yield what is observed from a reset on, and `info`."""
    env.action_space.seed(0)
    yield env.reset(seed=1)
    for _ in range(4):
        observed, *_, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observed)
        yield observed, info


@pytest.mark.parametrize("exclude", [[], ["action"], ["reward", "slice"], ["action", "reward", "slice"]], ids=str)
def test_stack_gives_each_part_of_a_dict_a_leading_axis_but_those_left_out(wrist, exclude):
    stacked = image_env(wrist, stack=3, stack_exclude=exclude)
    latest = []
    for (bare, _), (observed, _) in zip(steps(image_env(wrist)), steps(stacked), strict=True):
        latest = [*(latest or [bare] * 2), bare][-3:]
        for name, part in observed.items():
            expected = bare[name] if name in exclude else np.stack([frame[name] for frame in latest])
            np.testing.assert_array_equal(part, expected)
            assert part.dtype == bare[name].dtype


def test_stack_begins_anew_with_each_episode(wrist):
    env = image_env(wrist, stack=3)
    list(steps(env))
    observed, _ = env.reset(seed=2)
    assert all((part == part[0]).all() for part in observed.values())


@pytest.mark.parametrize(
    ("flat", "exclude"),
    [(True, ["action"]), (True, [""]), (False, ["clusters"]), (False, "action"), (False, [["action"]])],
)
def test_stack_refuses_to_leave_out_what_is_not_there(wrist, flat, exclude):
    with pytest.raises(InvalidValueError, match="stack_exclude is"):
        make_armscan_env([wrist], observation="action_reward", flat=flat, stack=2, stack_exclude=exclude)


def test_memory_is_a_part_of_a_dict(wrist):
    env = image_env(wrist, memory=2)
    pairs = []
    for (bare, _), (observed, info) in zip(steps(image_env(wrist)), steps(env), strict=True):
        pair = np.array([*info["action"], info["reward"]], np.float32)
        # No later plane is better than the first.
        pairs = pairs or [pair, pair]
        assert pair[-1] <= pairs[-1][-1]
        np.testing.assert_array_equal(observed.pop("memory"), np.concatenate(pairs))
        assert observed.keys() == bare.keys()
        for name, part in bare.items():
            np.testing.assert_array_equal(observed[name], part)


@pytest.mark.parametrize("flat", [True, False], ids=["flat", "dict"])
def test_memory_is_stacked_or_not_as_the_order_says(wrist, flat):
    arguments = {"observation": "action_reward", "projection": "zy", "flat": flat, "stack": 3, "memory": 2}
    after = make_armscan_env([wrist], **arguments)
    before = make_armscan_env([wrist], **arguments, stack_memory=True)
    alone = make_armscan_env([wrist], **arguments | {"stack": 1})
    frames = []
    for (a, _), (b, _), (bare, _) in zip(steps(after), steps(before), steps(alone), strict=True):
        frames = [*(frames or [bare] * 2), bare][-3:]
        if flat:
            np.testing.assert_array_equal(b, np.concatenate(frames))
            np.testing.assert_array_equal(a, np.concatenate([*(frame[:3] for frame in frames), bare[3:]]))
        else:
            np.testing.assert_array_equal(b["memory"], [frame["memory"] for frame in frames])
            np.testing.assert_array_equal(a["memory"], bare["memory"])
            np.testing.assert_array_equal(a["action"], b["action"])


def test_memory_refuses_an_observation_that_has_one(wrist):
    with pytest.raises(InvalidValueError, match="already has a part 'memory'"):
        BestActionMemory(image_env(wrist, memory=1), 1)


@pytest.mark.parametrize("wrapper", [VectorFrameStack, VectorBestActionMemory])
def test_vector_wrappers_refuse_environments_that_reset_in_the_same_step(phantom, wrapper):
    options = {"autoreset_mode": AutoresetMode.SAME_STEP}
    envs = SyncVectorEnv([lambda: ArmscanEnv([phantom], observation="cluster")] * 2, **options)
    with pytest.raises(InvalidValueError, match=rf"{wrapper.__name__} wraps environments that reset at the next step"):
        wrapper(envs, 2)


@pytest.mark.parametrize("wrapper", [FrameStack, BestActionMemory])
@pytest.mark.parametrize(
    "space", [gym.spaces.Box(0, 1, (2, 2)), gym.spaces.Discrete(3), gym.spaces.Dict({"a": gym.spaces.Discrete(3)})]
)
def test_wrappers_refuse_observations_that_they_cannot_hold(wrapper, space):
    env = Scripted([])
    env.observation_space = space
    with pytest.raises(InvalidValueError, match=f"{wrapper.__name__} wraps observations that are vectors or a Dict"):
        wrapper(env, 2)

"""The vector environment under Tianshou's interface."""

import numpy as np
import pytest
from tianshou.data import Batch
from tianshou.env import BaseVectorEnv

from armscan.agents.tianshou_envs import TianshouVectorEnv
from armscan.envs import ArmscanEnv, EnvFactory
from tests.agents.conftest import setup_for


@pytest.fixture
def make(phantom):
    def make(**rules):
        env_factory = EnvFactory(projection="zy", max_steps=4, **rules)
        envs = TianshouVectorEnv(env_factory.make_vector_env(3, [phantom]))
        envs.seed([7, 8, 9])
        return envs

    return make


def test_tianshou_vector_env_steps_as_single_environments_do(make, phantom):
    envs = make()
    assert isinstance(envs, BaseVectorEnv)
    assert len(envs) == 3
    observed, _ = envs.reset()
    single = ArmscanEnv([phantom], projection="zy", max_steps=4)
    np.testing.assert_array_equal(observed[1], single.reset(seed=8)[0])
    action = np.array([0.1, -0.3])
    observed, rewards, terminated, truncated, info = envs.step(np.tile(action, (3, 1)))
    expected, reward, *ends, _ = single.step(action)
    np.testing.assert_array_equal(observed[1], expected)
    assert (rewards[1], [terminated[1], truncated[1]]) == (reward, ends)
    assert [each["env_id"] for each in info] == [0, 1, 2]


def test_tianshou_vector_env_resets_only_those_it_is_asked_for(make):
    envs = make()
    envs.reset()
    before, *_ = envs.step(np.zeros((3, 2)))
    observed, info = envs.reset([2])
    assert observed.shape == (1, before.shape[1])
    assert info[0]["env_id"] == 2
    # The start of an episode: the free components in the middle.
    np.testing.assert_array_equal(observed[0, -3:-1], [0, 0])


@pytest.mark.parametrize("ends", ["on_reward", "on_budget", "on_stop"])
def test_tianshou_vector_env_counts_episodes_and_those_that_succeed(make, phantom, ends):
    envs = make(success_threshold=0.6, ends=ends)
    envs.reset()
    rng, n_ended, n_successes = np.random.default_rng(0), 0, 0
    for _ in range(12):
        _, rewards, terminated, truncated, _ = envs.step(rng.uniform(-1, 1, (3, 3 if ends == "on_stop" else 2)))
        is_over = terminated | truncated
        # An episode succeeds if its last plane scores above -success_threshold.
        n_ended, n_successes = n_ended + is_over.sum(), n_successes + (rewards[is_over] > -0.6).sum()
        if is_over.any():
            envs.reset(np.flatnonzero(is_over))
    assert (envs.n_ended, envs.n_successes) == (n_ended, n_successes)
    assert 0 < envs.n_successes < envs.n_ended


def test_tianshou_vector_env_gives_images_as_batches(make):
    envs = make(observation="slice", stack=2)
    envs.reset()
    observed, _ = envs.reset([0, 1])
    assert isinstance(observed, Batch)
    assert observed.slice.shape == (2, 2, 360, 80)


def test_collector_steps_the_vector_environment(make, phantom, monkeypatch):
    """A learner's collector, on environments of our factory: all planes of a step are looked at together."""
    from armscan.agents import MLP, SAC
    from armscan.anatomy import Scanner

    env_factory = EnvFactory(projection="zy", max_steps=4)
    algorithm = SAC(network=MLP((8,)), num_envs=4, learning_starts=20, batch_size=8)
    learner = algorithm.agent(setup_for(env_factory, phantom))
    looked_at = []
    look_all = Scanner.look_all
    monkeypatch.setattr(Scanner, "look_all", lambda *a: looked_at.append(len(a[1])) or look_all(*a))
    learner.warm_up()
    assert looked_at.count(4) >= 5

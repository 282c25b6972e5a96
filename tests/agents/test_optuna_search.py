"""Optuna as the searcher over the plane."""

import logging

import numpy as np
import pytest

from armscan.agents import Learner, OptunaSearch, Random
from armscan.agents.optuna_search import SAMPLERS
from armscan.errors import InvalidValueError
from tests.agents.conftest import ENV_FACTORIES, setup_for
from tests.agents.test_baselines import BOUNDS
from tests.agents.test_plane_finder import NAMES


def agent_of(algorithm, phantom, n_action):
    env_factory, _ = ENV_FACTORIES["vector"]
    return algorithm.agent(setup_for(env_factory, phantom, action_names=NAMES[:n_action]))


def played(agent, n_planes, seed, optimum=0.3):
    """Planes of an episode whose reward falls off smoothly from an optimum, and their rewards."""
    agent.begin(seed=seed, bounds=BOUNDS)
    planes, rewards = [], [-0.9]
    for _ in range(n_planes):
        planes.append(agent.act(np.zeros(3, np.float32), rewards[-1]))
        rewards.append(-float(np.mean((planes[-1] - optimum) ** 2)) / 4.0)
    return np.array(planes), rewards[1:]


@pytest.mark.parametrize("n_action", [1, 2, 4])
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_search_repeats_an_episode_and_stays_within_bounds(phantom, sampler, n_action):
    agent = agent_of(OptunaSearch(sampler=sampler), phantom, n_action)
    assert not isinstance(agent, Learner)
    planes, _ = played(agent, 14, seed=3_000_000)
    assert planes.shape == (14, n_action)
    assert np.abs(planes).max() <= 1.0
    other, _ = played(agent, 14, seed=3_000_001)
    assert not np.array_equal(other, planes)
    np.testing.assert_array_equal(played(agent, 14, seed=3_000_000)[0], planes)


@pytest.mark.parametrize(
    ("sampler", "n_episodes"), [("tpe", 20), ("cmaes", 20), pytest.param("gp", 2, marks=pytest.mark.full)]
)
@pytest.mark.parametrize("n_action", [1, 2])
def test_search_beats_random_planes_where_the_reward_is_smooth(phantom, sampler, n_episodes, n_action):
    # The later planes show whether the search has learned from the first ones, with one component as with two.
    last = {}
    for name, algorithm in (("search", OptunaSearch(sampler=sampler)), ("random", Random())):
        agent = agent_of(algorithm, phantom, n_action)
        last[name] = np.mean([np.mean(played(agent, 30, seed)[1][20:]) for seed in range(n_episodes)])
    assert last["search"] > last["random"] / 2


def test_search_never_stops_by_itself(phantom):
    env_factory, _ = ENV_FACTORIES["vector"]
    agent = OptunaSearch().agent(setup_for(env_factory, phantom, action_names=("rz", "ty", "stop")))
    planes, _ = played(agent, 5, seed=0)
    assert (planes[:, 2] == -1.0).all()
    assert (np.abs(planes[:, :2]) < 1.0).all()


def test_search_is_told_every_reward_but_the_starts(phantom):
    agent = agent_of(OptunaSearch(), phantom, 1)
    _, rewards = played(agent, 5, seed=0)
    assert [trial.value for trial in agent._study.trials] == [*rewards[:4], None]


def test_search_begins_with_as_many_random_planes_as_wanted(phantom):
    # Both draw the same random planes until the model takes over.
    few, many = (
        played(agent_of(OptunaSearch(n_startup_trials=n), phantom, 1), 10, seed=1)[0].ravel().tolist() for n in (2, 10)
    )
    assert few[:2] == many[:2]
    assert few[2] != many[2]


def test_search_says_nothing(phantom, capfd):
    for sampler in SAMPLERS:
        played(agent_of(OptunaSearch(sampler=sampler), phantom, 1), 12, seed=1)
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""
    assert logging.getLogger("optuna").getEffectiveLevel() >= logging.ERROR


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sampler": "grid"}, r"agent\.sampler is 'grid', but it must be tpe, cmaes or gp"),
        ({"sampler": None}, r"agent\.sampler is None"),
        ({"n_startup_trials": 0}, r"agent\.n_startup_trials is 0, but it must be a whole number of at least 1"),
    ],
)
def test_search_refuses_what_there_is_not(arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        OptunaSearch(**arguments)

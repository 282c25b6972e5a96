"""Agents that learn nothing and model nothing."""

import numpy as np
import pytest

from armscan.agents import Exhaustive, Learner, OptunaSearch, Random
from armscan.envs import ArmscanEnv
from armscan.envs.actions import ActionBounds
from armscan.errors import InvalidValueError
from armscan.training import evaluate
from tests.agents.conftest import ENV_FACTORIES, setup_for

BOUNDS = ActionBounds((90.0, 45.0), (97.2, 216.0))
FREE = {"y": ("ty",), "x": ("tx",), "zy": ("rz", "ty"), "xy": ("tx", "ty"), "full": ("rz", "rx", "tx", "ty")}


def agent_of(algorithm, phantom, projection="y"):
    env_factory, _ = ENV_FACTORIES["vector"]
    return algorithm.agent(setup_for(env_factory, phantom, action_names=FREE[projection]))


def planes(agent, n, seed=0, bounds=BOUNDS, rewards=()):
    """Return the first planes of an episode; the agent is told `rewards` for them, and -0.5 after those."""
    agent.begin(seed=seed, bounds=bounds)
    told = [-0.9, *rewards] + [-0.5] * n
    return np.array([agent.act(np.zeros(3, np.float32), reward) for reward in told[:n]])


@pytest.mark.parametrize("algorithm", [Random(), Exhaustive()], ids=lambda algorithm: type(algorithm).__name__)
def test_baseline_is_no_learner_and_repeats_an_episode(algorithm, phantom):
    agent = agent_of(algorithm, phantom, "zy")
    assert not isinstance(agent, Learner)
    first = planes(agent, 30, seed=5)
    assert first.shape == (30, 2)
    assert np.abs(first).max() <= 1.0
    planes(agent, 7, seed=6)
    np.testing.assert_array_equal(planes(agent, 30, seed=5), first)


def test_random_fills_the_range_and_differs_between_episodes(phantom):
    agent = agent_of(Random(), phantom, "full")
    drawn = planes(agent, 500, seed=1)
    assert (np.abs(drawn.mean(axis=0)) < 0.1).all()
    assert (drawn.min(axis=0) < -0.95).all()
    assert (drawn.max(axis=0) > 0.95).all()
    assert not np.array_equal(planes(agent, 5, seed=2), drawn[:5])


def test_random_draws_nothing_that_the_environment_draws_from_the_same_seed(phantom):
    agent = agent_of(Random(), phantom, "full")
    drawn = [planes(agent, 1, seed=seed)[0] for seed in range(300)]
    moved = [np.random.default_rng(seed).uniform(-1.0, 1.0, 4) for seed in range(300)]
    correlations = np.corrcoef(np.array(drawn).T, np.array(moved).T)[:4, 4:]
    assert np.abs(correlations).max() < 0.25


def test_sweep_visits_every_plane_once_from_the_middle_outward(phantom):
    swept = planes(agent_of(Exhaustive(), phantom), 43)
    ty_mm = [BOUNDS.denormalise((0, 0, 0, ty)).translation[1] for (ty,) in swept]
    np.testing.assert_allclose(ty_mm[:5], [108, 103, 113, 98, 118])
    offsets_mm = np.abs(np.array(ty_mm) - 108.0)
    assert (np.diff(offsets_mm) > -1e-9).all()
    np.testing.assert_allclose(np.sort(ty_mm), np.arange(3.0, 216.0, 5.0))


@pytest.mark.parametrize("bound_mm", [0.3, 0.7, 30.0, 99.99999999999999, 216.00000858306885, 1e6])
@pytest.mark.parametrize("n_steps", [1, 2, 3, 7, 12])
def test_sweep_includes_both_ends_where_its_steps_divide_the_range(phantom, bound_mm, n_steps):
    step_mm = bound_mm / (2 * n_steps)
    bounds = ActionBounds((90.0, 45.0), (bound_mm, bound_mm))
    swept = agent_of(Exhaustive(step_mm=step_mm), phantom).planes(bounds)
    assert len(swept) == 2 * n_steps + 1
    assert swept.min() == -1.0
    assert swept.max() == 1.0
    ends = [bounds.denormalise((0, 0, 0, ty)).translation[1] for ty in (swept.min(), swept.max())]
    assert ends == [0.0, bound_mm]


def test_sweep_stays_at_the_best_plane_after_all_were_seen(phantom):
    bounds = ActionBounds((90.0, 45.0), (97.2, 22.0))
    agent = agent_of(Exhaustive(), phantom)
    swept = planes(agent, 9, bounds=bounds, rewards=[-0.7, -0.6, -0.2, -0.6, -0.5, -0.2, 0.0, 0.0])
    np.testing.assert_allclose((swept[:5, 0] + 1) * 11, [11, 6, 16, 1, 21])
    # After the sweep, its best plane is repeated, and further rewards are ignored.
    assert (swept[5:] == swept[2]).all()


@pytest.mark.parametrize("algorithm", [Exhaustive(), OptunaSearch()], ids=lambda algorithm: type(algorithm).__name__)
@pytest.mark.parametrize("max_steps", [2, 7, 60])
def test_search_ends_an_episode_of_a_number_of_steps_at_its_best_plane(phantom, algorithm, max_steps):
    env = ArmscanEnv([phantom], ends="on_budget", max_steps=max_steps)
    env_factory, _ = ENV_FACTORIES["vector"]
    agent = algorithm.agent(setup_for(env_factory, phantom, action_names=("ty",), n_steps=env.rules.n_steps))
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        agent.begin(seed=seed, bounds=BOUNDS)
        told, rewards = info["reward"], []
        for _ in range(max_steps):
            observation, told, *_ = env.step(agent.act(observation, told))
            rewards.append(told)
        assert rewards[-1] == max(rewards)


def test_sweep_holds_the_other_free_components_at_the_plane_straight_across(phantom):
    swept = planes(agent_of(Exhaustive(), phantom, "full"), 20)
    plane = BOUNDS.denormalise(swept[7])
    assert plane.rotation == (0.0, 0.0)
    assert plane.translation[0] == 0.0
    assert len(np.unique(swept[:, 3])) == 20


@pytest.mark.parametrize("swept", [None, ["ty"]])
def test_sweep_never_stops_by_itself(phantom, swept):
    env_factory, _ = ENV_FACTORIES["vector"]
    agent = Exhaustive(swept=swept, step_mm=20.0).agent(
        setup_for(env_factory, phantom, action_names=("rz", "ty", "stop"))
    )
    seen = planes(agent, 30)
    assert seen.shape == (30, 3)
    assert (seen[:, 2] == -1.0).all()


def test_sweep_stays_where_a_component_cannot_move(phantom):
    swept = agent_of(Exhaustive(swept=["rz", "ty"]), phantom, "zy").planes(ActionBounds((0.0, 0.0), (10.0, 0.0)))
    np.testing.assert_array_equal(swept, [[0.0, 0.0]])


@pytest.mark.parametrize(("projection", "n_planes"), [("y", 43), ("zy", 19 * 43), ("xy", 19 * 43)])
def test_grid_visits_every_plane_once_the_nearest_first(phantom, projection, n_planes):
    grid = agent_of(Exhaustive(swept=None), phantom, projection).planes(BOUNDS)
    assert grid.shape == (n_planes, len(FREE[projection]))
    assert len(np.unique(grid.round(9), axis=0)) == n_planes
    np.testing.assert_array_equal(grid[0], 0.0)
    steps_of = {"rz": 9.0, "tx": 48.6 / 5.0, "ty": 108.0 / 5.0}
    distances = np.linalg.norm(grid * [steps_of[name] for name in FREE[projection]], axis=1)
    assert (np.diff(distances) > -1e-9).all()
    if projection == "zy":
        assert set(grid[:, 0].round(9)) == set((np.arange(-9, 10) / 9).round(9))


def test_sweep_finds_wrists_in_as_many_slices_as_published(dataset, phantom):
    env = ArmscanEnv(dataset, projection="y")
    evaluation = evaluate(agent_of(Exhaustive(), phantom), env, n_episodes=40, seed=0)
    assert evaluation.success_rate == 1.0
    assert 4 <= evaluation.mean_steps <= 13


@pytest.mark.parametrize(
    ("arguments", "projection", "message"),
    [
        ({"step_mm": -1}, "y", r"agent\.step_mm is -1, but it must be a finite number at least 0\.01"),
        ({"step_deg": float("nan")}, "y", r"agent\.step_deg is nan"),
        ({"swept": "ty"}, "y", r"agent\.swept is 'ty', but it must be a list of one or two"),
        ({"swept": []}, "y", r"agent\.swept is \[\]"),
        ({"swept": ["ty", "ty"]}, "y", r"agent\.swept is \['ty', 'ty'\]"),
        ({"swept": ["ty", 3]}, "y", r"agent\.swept is \['ty', 3\]"),
        ({"swept": ["rz", "tx", "ty"]}, "full", r"agent\.swept is \['rz', 'tx', 'ty'\], but .* one or two"),
        ({"swept": ["q"]}, "y", r"agent\.swept is \['q'\], but .* rz, rx, tx or ty"),
        ({}, "x", r"agent\.swept is \['ty'\], but ty is not free; projection leaves only tx free"),
        ({"swept": None}, "full", r"agent\.swept is null, .* but it must be one or two, because .* thousands"),
    ],
)
def test_exhaustive_refuses_what_it_cannot_sweep(phantom, arguments, projection, message):
    with pytest.raises(InvalidValueError, match=message):
        agent_of(Exhaustive(**arguments), phantom, projection)


def test_exhaustive_refuses_more_planes_than_anyone_looks_at(phantom):
    agent = agent_of(Exhaustive(swept=None, step_mm=0.01, step_deg=0.01), phantom, "zy")
    with pytest.raises(InvalidValueError, match=r"step_mm is 0\.01 .* planes of rz and ty, but .* at most 1000000"):
        agent.begin(seed=0, bounds=BOUNDS)

"""The supervised agent; what it shares with every learner is in test_learners.py."""

from functools import partial

import numpy as np
import pytest
import torch

from armscan.agents import MLP, Regression
from armscan.agents.supervised_buffer import SupervisedBuffer
from armscan.envs import ArmscanVectorEnv, EnvFactory
from armscan.envs.spaces import MultiBoxSpace
from armscan.errors import DivergedError, InvalidValueError
from armscan.training import evaluate
from armscan.volumes import load_phantoms
from tests.agents.conftest import ENV_FACTORIES, SMALL_REGRESSION, setup_for


def test_optimal_actions_are_those_of_each_environments_episode(phantom):
    envs = ArmscanVectorEnv(3, [phantom], projection=["rz", "ty"], autoreset_mode="Disabled")
    envs.reset(seed=5)
    optima = envs.optimal_actions
    assert optima.shape == (3, 2)
    assert len(np.unique(optima, axis=0)) == 3
    _, rewards, terminated, _, infos = envs.step(optima)
    assert terminated.all()
    assert (rewards > -0.05).all()
    np.testing.assert_allclose(infos["distance_mm"], 0, atol=1e-4)
    # The others continue their episodes.
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    changed = (envs.optimal_actions != optima).any(axis=1)
    assert changed.tolist() == [False, True, False]


def test_optimal_actions_are_told_to_no_agent(phantom):
    env_factory, _ = ENV_FACTORIES["images"]
    envs = env_factory.make_vector_env(2, [phantom])
    observations, infos = envs.reset(seed=0)
    optima = envs.unwrapped.optimal_actions.astype(np.float32)
    for part in [*observations.values(), *infos.values()]:
        assert np.shape(part)[1:] != (2,) or not np.allclose(np.asarray(part, dtype=float), optima)


def test_regression_keeps_what_it_sees_with_the_optimum_of_that_episode(phantom):
    env_factory, network = ENV_FACTORIES["vector"]
    learner = Regression(network=network, **SMALL_REGRESSION | {"num_envs": 1, "own_planes_share": 0.0}).agent(
        setup_for(env_factory, phantom)
    )
    learner.learn(40)
    state = learner.state()["examples"]
    observations, optima = next(iter(state["parts"].values())).numpy(), state["optima"].numpy()
    assert len(optima) == 40
    # The last three numbers of an observation are action and reward; episodes begin in the middle.
    starts = np.flatnonzero((observations[:, -3:-1] == 0).all(axis=1))
    assert starts[0] == 0
    assert len(starts) > 1
    for first, following in zip(starts, [*starts[1:], 40], strict=True):
        assert (optima[first:following] == optima[first]).all()
        assert first == 0 or (optima[first] != optima[first - 1]).any()


def test_examples_make_way_for_new_ones_and_come_back_from_their_state(phantom):
    space = MultiBoxSpace({"a": ENV_FACTORIES["vector"][0].make_env([phantom]).action_space})
    examples = SupervisedBuffer(5, space, 1)
    for i in range(4):
        examples.add({"a": np.full((2, 2), i, np.float32)}, np.full((2, 1), float(i)))
    assert len(examples) == 5
    observations, optima = examples.draw(300, np.random.default_rng(0))
    assert sorted(set(optima.ravel())) == [1, 2, 3]
    np.testing.assert_array_equal(observations["a"][:, :1], optima)
    other = SupervisedBuffer(5, space, 1)
    other.load_state(examples.state())
    for each in (examples, other):
        each.add({"a": np.full((1, 2), 9, np.float32)}, np.full((1, 1), 9.0))
    drawn = [each.draw(50, np.random.default_rng(1))[1] for each in (examples, other)]
    np.testing.assert_array_equal(*drawn)
    assert 9 in drawn[0]


@pytest.mark.full
def test_regression_learns_where_the_plane_lies_on_two_phantoms():
    volumes = list(load_phantoms(range(2)).values())
    env_factory = EnvFactory(projection="zy", rotation_bounds_deg=(90.0, 45.0))
    env = env_factory.make_env(volumes)
    setup = setup_for(
        env_factory,
        volumes[0],
        make_envs=partial(env_factory.make_vector_env, volumes=volumes),
        observation_space=env.observation_space,
        total_env_steps=3000,
    )
    learner = Regression(network=MLP((64, 64))).agent(setup)
    before = evaluate(learner, env, n_episodes=20, seed=0)
    first = learner.learn(500)["update/loss"]
    learner.learn(2000)
    last = learner.learn(500)["update/loss"]
    after = evaluate(learner, env, n_episodes=20, seed=0)
    assert last < first / 2
    assert after.success_rate >= 0.8 > before.success_rate
    assert after.metrics()["mean_distance_mm"] < 10


def test_regression_learns_from_random_planes_and_those_near_its_own(phantom):
    env_factory, network = ENV_FACTORIES["vector"]
    near = {}
    for share in (0.0, 0.5, 1.0):
        small = SMALL_REGRESSION | {"num_envs": 400, "own_planes_share": share}
        learner = Regression(network=network, **small).agent(setup_for(env_factory, phantom, total_env_steps=1000))
        observations, _ = learner._envs.reset(seed=0)
        with torch.no_grad():
            chosen = learner._predicted(observations).numpy().clip(-1, 1)
        planes = learner._next_planes(observations, np.random.default_rng(0))
        assert np.abs(planes).max() <= 1
        near[share] = (np.abs(planes - chosen).max(axis=1) < 0.05).mean()
    assert near[0.0] < 0.02
    assert 0.2 < near[0.5] < 0.4 < near[1.0] < 0.8


def test_regression_does_not_depend_on_earlier_observations(phantom):
    env_factory, network = ENV_FACTORIES["images"]
    learner = Regression(network=network, **SMALL_REGRESSION).agent(setup_for(env_factory, phantom))
    env = env_factory.make_env([phantom])
    observation, _ = env.reset(seed=0)
    action = learner.act(observation, -0.3)
    learner.act({name: np.zeros_like(part) for name, part in observation.items()}, 0.0)
    np.testing.assert_array_equal(learner.act(observation, -0.9), action)


def test_regression_says_that_it_has_diverged(phantom):
    env_factory, network = ENV_FACTORIES["vector"]
    learner = Regression(network=network, **SMALL_REGRESSION).agent(setup_for(env_factory, phantom))
    for weights in learner._network.parameters():
        weights.data.fill_(float("nan"))
    with pytest.raises(DivergedError, match=r"learning has diverged: after \d+ environment steps .* agent\.lr"):
        learner.learn(20)


def test_regression_without_an_update_in_an_epoch_reports_no_loss(phantom):
    env_factory, network = ENV_FACTORIES["vector"]
    learner = Regression(network=network, num_envs=2, batch_size=16, utd_ratio=0.01).agent(
        setup_for(env_factory, phantom)
    )
    metrics = learner.learn(10)
    assert "update/loss" not in metrics
    assert metrics["speed/updates_per_s"] == 0
    assert metrics["replay_size"] == 10
    learner.learn(100)
    assert torch.isfinite(learner.weights()["mu.model.0.weight"]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"utd_ratio": 0}, r"agent\.utd_ratio is 0"),
        ({"buffer_size": 0}, r"agent\.buffer_size is 0"),
        ({"buffer_size": 3, "num_envs": 4}, r"agent\.num_envs is 4, but it must be at most agent\.buffer_size = 3"),
    ],
)
def test_regression_refuses_impossible_parameters(changes, message):
    with pytest.raises(InvalidValueError, match=message):
        Regression(network=MLP(), **changes)

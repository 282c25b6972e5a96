"""SAC through Tianshou's builder."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from armscan.agents import MLP, SAC, LearningSetup, checked_device
from armscan.envs import EnvMaker
from armscan.errors import DivergedError, InvalidValueError

MAKER = EnvMaker(projection="zy")
SMALL = {"num_envs": 2, "random_env_steps": 20, "batch_size": 16, "env_steps_per_collection": 4}


@pytest.fixture
def setup(phantom):
    return LearningSetup(
        make_envs=partial(MAKER.many, volumes=[phantom], autoreset_mode="Disabled"),
        observation_space=MAKER.one([phantom]).observation_space,
        total_env_steps=100,
        seed=3,
        device="cpu",
    )


@pytest.fixture
def make_learner(setup):
    return lambda **changes: SAC(network=MLP((8,)), **(SMALL | changes)).learner(setup)


def test_learner_counts_every_environment_step(make_learner):
    learner = make_learner()
    learner.warm_up()
    assert learner.n_env_steps == 20
    learner.learn(30)
    assert 50 <= learner.n_env_steps <= 53
    learner.learn(7)
    assert 57 <= learner.n_env_steps <= 64


def test_learner_reports_episodes_losses_and_speed(make_learner):
    learner = make_learner()
    learner.warm_up()
    metrics = learner.learn(60)
    assert {"update/actor_loss", "update/critic_loss", "update/entropy_coefficient"} <= metrics.keys()
    assert metrics["speed/env_steps_per_s"] > 0
    assert all(np.isfinite(value) for value in metrics.values())
    if metrics["train/episodes"]:
        assert 1 <= metrics["train/length"] <= 50
        assert -50 <= metrics["train/return"] <= 0


def test_learner_acts_without_exploration(make_learner, phantom):
    learner, env = make_learner(), MAKER.one([phantom])
    observation, _ = env.reset(seed=0)
    action = learner.act(observation)
    assert env.action_space.contains(action)
    np.testing.assert_array_equal(action, learner.act(observation))


def weights(learner):
    return [value for value in learner.state().values() if isinstance(value, torch.Tensor)]


def test_learner_of_the_same_seed_learns_the_same(make_learner):
    learned = []
    for _ in range(2):
        learner = make_learner()
        learner.warm_up()
        learner.learn(20)
        learned.append(weights(learner))
    assert all(torch.equal(a, b) for a, b in zip(*learned, strict=True))


def test_learning_changes_the_weights_and_load_state_brings_them_back(make_learner, setup):
    learner = make_learner()
    learner.warm_up()
    before = [value.clone() for value in weights(learner)]
    state = {key: value.clone() if hasattr(value, "clone") else value for key, value in learner.state().items()}
    learner.learn(20)
    assert not all(torch.equal(a, b) for a, b in zip(before, weights(learner), strict=True))
    learner.load_state(state)
    assert all(torch.equal(a, b) for a, b in zip(before, weights(learner), strict=True))


def test_replay_buffer_is_no_larger_than_the_training(make_learner):
    assert make_learner(buffer_size=10**9)._collector.buffer.maxsize <= 110


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lr": 0}, r"agent\.lr is 0"),
        ({"lr": 1e300}, r"agent\.lr is 1e\+300"),
        ({"lr": "fast"}, r"agent\.lr is 'fast'"),
        ({"gamma": 1.5}, r"agent\.gamma is 1\.5"),
        ({"batch_size": 0}, r"agent\.batch_size is 0"),
        ({"num_envs": 2.5}, r"agent\.num_envs is 2\.5"),
        ({"updates_per_env_step": -1}, r"agent\.updates_per_env_step is -1"),
        ({"random_env_steps": 100}, r"agent\.random_env_steps is 100, .* must be below"),
        ({"random_env_steps": 1, "num_envs": 100}, r"agent\.random_env_steps is 1, 100 for 100 environments"),
        ({"buffer_size": 10}, r"agent\.batch_size is 16, but it must be at most agent\.buffer_size = 10"),
    ],
)
def test_sac_refuses_impossible_parameters(make_learner, changes, message):
    with pytest.raises(InvalidValueError, match=message):
        make_learner(**changes)


@pytest.mark.parametrize("part", ["policy.actor", "critic"])
def test_learner_says_that_it_has_diverged(make_learner, part):
    learner = make_learner()
    learner.warm_up()
    for weights in learner._algorithm.get_submodule(part).parameters():
        weights.data.fill_(float("nan"))
    with pytest.raises(DivergedError, match=r"learning has diverged: after \d+ environment steps"):
        learner.learn(60)


@pytest.mark.parametrize(
    "arguments", [{"hidden_sizes": (0,)}, {"hidden_sizes": "64"}, {"hidden_sizes": 64}, {"activation": "step"}]
)
def test_mlp_refuses_impossible_layers(arguments):
    with pytest.raises(InvalidValueError, match=next(iter(arguments))):
        MLP(**arguments)


def test_checked_device_names_what_there_is():
    assert checked_device("cpu") == "cpu"
    with pytest.raises(InvalidValueError, match="device is 'tpu', but it must be cpu or cuda"):
        checked_device("tpu")


def test_learner_refuses_observations_that_its_network_cannot_take(setup, phantom):
    images = EnvMaker(observation="slice", projection="zy").one([phantom]).observation_space
    with pytest.raises(InvalidValueError, match=r"mlp, which takes one vector, but .* action, reward, slice; take obs"):
        SAC(network=MLP((8,)), **SMALL).learner(replace(setup, observation_space=images))

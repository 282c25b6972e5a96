"""Contract of every learner: SAC, PPO and the regression, with vectors and with images."""

import numpy as np
import pytest
import torch

from armscan.agents import PPO, SAC, Learner, Regression
from armscan.errors import CheckpointError, DivergedError, InvalidValueError
from armscan.training import load_checkpoint, save_checkpoint
from tests.agents.conftest import ALGORITHMS, ENV_FACTORIES, SMALL_SAC, setup_for
from tests.support.tensors import assert_same_tensors, named_tensors

by_reinforcement = pytest.mark.parametrize("algorithm", ["sac", "ppo"], indirect=True)


def begun(learner, env):
    observation, info = env.reset(seed=0)
    learner.begin(seed=0, bounds=env.get_wrapper_attr("scene").bounds)
    return observation, float(info["reward"])


def test_learner_has_all_that_training_needs(make_learner):
    assert isinstance(make_learner(), Learner)


def test_learner_counts_every_environment_step(make_learner):
    learner = make_learner()
    learner.warm_up()
    first = learner.n_env_steps
    assert first in (0, 20)
    learner.learn(40)
    assert first + 40 <= learner.n_env_steps <= first + 60
    assert learner.learn(7)["speed/env_steps_per_s"] > 0
    before = learner.n_env_steps
    learner.learn(1)
    assert learner.n_env_steps - before == learner.env_steps_at_once


@pytest.mark.parametrize("algorithm", ["sac"], indirect=True)
def test_learner_of_many_updates_a_collection_shows_no_bars_of_its_own(make_learner, capfd):
    learner = make_learner(env_steps_per_collection=20, utd_ratio=2.0)
    learner.warm_up()
    learner.learn(40)
    assert "".join(capfd.readouterr()) == ""


@by_reinforcement
def test_learner_learns_while_the_wall_clock_is_turned_back(make_learner, monkeypatch):
    hours = iter(range(10**6, 0, -1))
    monkeypatch.setattr("time.time", lambda: 3600.0 * next(hours))
    learner = make_learner()
    learner.warm_up()
    assert learner.learn(40)["speed/env_steps_per_s"] > 0


@by_reinforcement
def test_learner_reports_episodes_losses_and_speed(make_learner):
    learner = make_learner()
    learner.warm_up()
    metrics = learner.learn(60)
    assert {"update/actor_loss", "update/critic_loss", "speed/env_steps_per_s", "replay_size"} <= metrics.keys()
    assert metrics["speed/updates_per_s"] > 0
    assert all(np.isfinite(value) for value in metrics.values())
    if metrics["train/episodes"]:
        assert 1 <= metrics["train/length"] <= 50
        assert -50 <= metrics["train/return"] <= 0
        assert 0 <= metrics["train/success_rate"] <= 1


@pytest.mark.parametrize("algorithm", ["sac", "regression"], indirect=True)
@pytest.mark.parametrize("share", [0.1, 0.26, 0.7, 2.0])
def test_learner_takes_as_many_gradient_steps_as_are_asked_for_also_after_going_on(algorithm, phantom, share):
    env_factory, network = ENV_FACTORIES["vector"]
    learners = [algorithm(network, utd_ratio=share).agent(setup_for(env_factory, phantom)) for _ in range(2)]
    learners[0].warm_up()
    first, last = learners
    n_random = first.n_env_steps
    n_taken = [n_gradient_steps(first)]
    for n_env_steps in (12, 20):
        first.learn(n_env_steps)
        n_taken.append(n_gradient_steps(first))
    last.load_state(first.state())
    last.learn(48)
    n_taken.append(n_gradient_steps(last))
    assert last.n_env_steps - n_random == 80
    np.testing.assert_allclose(np.array(n_taken), share * np.array([0, 12, 32, 80]), atol=1)


def n_gradient_steps(learner):
    """As the optimiser counts them."""
    algorithm = getattr(learner, "_algorithm", None)
    optimiser = algorithm.policy_optim._optim if algorithm else learner._optimiser
    return int(max((state["step"] for state in optimiser.state.values()), default=0))


def test_learner_acts_without_exploration(make_learner, env):
    learner = make_learner()
    observation, reward = begun(learner, env)
    action = learner.act(observation, reward)
    assert env.action_space.contains(action)
    np.testing.assert_array_equal(action, learner.act(observation, reward))


@by_reinforcement
def test_learner_with_stochastic_evaluation_samples_from_the_episodes_seed(make_learner, env):
    learner = make_learner(deterministic_eval=False)
    observation, reward = begun(learner, env)
    first, second = learner.act(observation, reward), learner.act(observation, reward)
    assert not np.array_equal(first, second)
    begun(learner, env)
    np.testing.assert_array_equal(learner.act(observation, reward), first)


def test_learner_of_the_same_seed_learns_the_same(make_learner):
    learned = []
    for _ in range(2):
        learner = make_learner()
        learner.warm_up()
        learner.learn(20)
        learned.append(learner.state())
    assert_same_tensors(*learned)


def test_learner_goes_on_from_a_checkpoint_bit_for_bit(make_learner, tmp_path):
    learner = make_learner()
    learner.warm_up()
    learner.learn(20)
    save_checkpoint(tmp_path / "last.pt", learner.state(), {})
    other = make_learner()
    other.load_state(load_checkpoint(tmp_path / "last.pt")[0])
    # Random numbers drawn elsewhere in between must change nothing.
    torch.rand(7), np.random.rand(7)  # noqa: NPY002
    for each in (learner, other):
        each.learn(20)
        each.learn(20)
    assert learner.n_env_steps == other.n_env_steps
    assert len(named_tensors(learner.state())) > 15
    assert_same_tensors(learner.state(), other.state())


def test_weights_bring_back_what_the_policy_did(make_learner, env):
    learner = make_learner()
    observation, reward = begun(learner, env)
    weights = {name: tensor.clone() for name, tensor in learner.weights().items()}
    before = learner.act(observation, reward)
    learner.warm_up()
    learner.learn(60)
    assert not np.array_equal(learner.act(observation, reward), before)
    learner.load_weights(weights)
    np.testing.assert_array_equal(learner.act(observation, reward), before)


def test_load_refuses_what_belongs_to_another_network(make_learner):
    learner = make_learner()
    where_weights_are = next(iter(learner.state()))
    with pytest.raises(CheckpointError, match="another agent's or network's"):
        learner.load_weights({"layer": torch.zeros(3)})
    with pytest.raises(CheckpointError, match="another agent's or network's"):
        learner.load_state(learner.state() | {where_weights_are: {"layer": torch.zeros(3)}})


def test_sac_keeps_no_more_transitions_than_the_training_takes(phantom):
    env_factory, network = ENV_FACTORIES["vector"]
    learner = SAC(network=network, **SMALL_SAC, buffer_size=10**9).agent(setup_for(env_factory, phantom))
    assert learner._replay.maxsize <= 110


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lr": 0}, r"agent\.lr is 0"),
        ({"lr": 1e300}, r"agent\.lr is 1e\+300"),
        ({"lr": "fast"}, r"agent\.lr is 'fast'"),
        ({"batch_size": 0}, r"agent\.batch_size is 0"),
        ({"num_envs": 2.5}, r"agent\.num_envs is 2\.5"),
        ({"network": 64}, r"network is 64, but it must have the methods of Network"),
    ],
)
def test_algorithm_refuses_impossible_parameters(algorithm, changes, message):
    with pytest.raises(InvalidValueError, match=message):
        algorithm(**changes)


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        (SAC, {"gamma": 1.5}, r"agent\.gamma is 1\.5"),
        (SAC, {"deterministic_eval": "yes"}, r"agent\.deterministic_eval is 'yes'"),
        (SAC, {"utd_ratio": -1}, r"agent\.utd_ratio is -1"),
        (SAC, {"learning_starts": 100}, r"agent\.learning_starts is 100, .* must be below"),
        (SAC, {"learning_starts": 1, "num_envs": 100}, r"agent\.learning_starts is 1, 100 for 100 environments"),
        (SAC, {"utd_ratio": 0.01}, r"agent\.utd_ratio is 0\.01, .* at least 0\.0125 for one"),
        (
            SAC,
            {"env_steps_per_collection": 10**4},
            r"agent\.env_steps_per_collection is 10000, 10000 for 2 env.* at most 80 = training\.env_steps - 20",
        ),
        (SAC, {"learning_starts": 1, "num_envs": 60}, r"collection is 4, 60 for 60 environments, .* at most 40 = "),
        (SAC, {"batch_size": 200}, r"agent\.batch_size is 200, but it must be at most 102, which is all"),
        (SAC, {"buffer_size": 10}, r"agent\.batch_size is 16, but it must be at most agent\.buffer_size = 10"),
        (PPO, {"gamma": 1.5}, r"agent\.gamma is 1\.5"),
        (PPO, {"deterministic_eval": "yes"}, r"agent\.deterministic_eval is 'yes'"),
        (PPO, {"clip_range": -0.1}, r"agent\.clip_range is -0\.1"),
        (PPO, {"log_std_init": 5}, r"agent\.log_std_init is 5"),
        (PPO, {"n_epochs": 0}, r"agent\.n_epochs is 0"),
        (PPO, {"conditioned_sigma": 1}, r"agent\.conditioned_sigma is 1"),
        (
            PPO,
            {"env_steps_per_collection": 101},
            r"is 101, 102 for 2 environments, .* at most 100 = training\.env_steps$",
        ),
        (
            PPO,
            {"batch_size": 21},
            r"agent\.batch_size is 21, but it must be at most 20, the environment steps of a coll",
        ),
        (PPO, {"batch_size": 1}, r"agent\.batch_size is 1, .* at least 2 with agent\.normalize_advantage"),
        (Regression, {"num_envs": 101}, r"agent\.num_envs is 101, but it must be at most training\.env_steps = 100"),
        (Regression, {"batch_size": 103}, r"agent\.batch_size is 103, but it must be at most 102, which is all"),
        (
            Regression,
            {"utd_ratio": 0.001},
            r"agent\.utd_ratio is 0\.001, .* at least 0\.01 for one",
        ),
    ],
)
def test_algorithm_refuses_its_own_impossible_parameters(phantom, kind, changes, message):
    env_factory, network = ENV_FACTORIES["vector"]
    small = next(small for each, small in ALGORITHMS.values() if each is kind)
    with pytest.raises(InvalidValueError, match=message):
        kind(network=network, **small | changes).agent(setup_for(env_factory, phantom))


def test_learning_rates_come_down_to_their_final_share(make_learner):
    learner = make_learner(lr_end_factor=0.25)
    rates = []
    for _ in range(8):
        rates.append({round(group["lr"] / 1e-3, 6) for group in learner._lr_groups()})
        if len(rates) == 1:
            learner.warm_up()
        learner.learn(20)
    assert rates[0] == {1.0}
    assert all(len(each) == 1 for each in rates)
    falling = [each.pop() for each in rates]
    assert falling == sorted(falling, reverse=True)
    assert falling[-1] == 0.25


@by_reinforcement
@pytest.mark.parametrize("part", ["policy.actor", "critic"])
def test_learner_says_that_it_has_diverged(make_learner, part):
    learner = make_learner()
    learner.warm_up()
    for weights in learner._algorithm.get_submodule(part).parameters():
        weights.data.fill_(float("nan"))
    with pytest.raises(DivergedError, match=r"learning has diverged: after \d+ environment steps") as raised:
        learner.learn(60)
    assert ("agent.ent_coef_lr" in str(raised.value)) == hasattr(learner._algorithm, "alpha")

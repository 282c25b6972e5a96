"""Episodes played side by side are bit-identical to those played one by one."""

from functools import partial

import numpy as np
import pytest

from armscan.agents import (
    MLP,
    PPO,
    SAC,
    AgentSetup,
    Compute,
    Exhaustive,
    OptunaSearch,
    Random,
    Regression,
)
from armscan.envs import EnvFactory, SliceChannelsObservation
from armscan.errors import InvalidValueError
from armscan.training import Evaluation, evaluate
from armscan.training.episodes import play
from tests.agents.conftest import SMALL_MULTIMODAL, SMALL_PPO, SMALL_REGRESSION, SMALL_SAC

VECTOR = EnvFactory(projection="zy", max_steps=6, start="random")
MEMORY = EnvFactory(projection="zy", max_steps=6, stack=3, memory=2)
IMAGES = EnvFactory(
    projection="zy",
    max_steps=5,
    observation=SliceChannelsObservation(shape=(36, 36)),
    stack=2,
    stack_exclude=["action"],
    memory=2,
    stack_memory=True,
)
# Hardly trained, but with actions that differ from one observation to another.
WIDE = {"network": MLP((33, 17)), "lr": 0.02}
CASES = {
    "random": (Random(), VECTOR),
    "exhaustive": (Exhaustive(), MEMORY),
    "optuna": (OptunaSearch(n_startup_trials=2), VECTOR),
    "sac": (SAC(**SMALL_SAC | WIDE), VECTOR),
    "sac of many layers, with memory": (SAC(**SMALL_SAC | WIDE | {"network": MLP((7, 5, 3))}), MEMORY),
    "sac without hidden layers": (SAC(**SMALL_SAC | WIDE | {"network": MLP(())}), VECTOR),
    "sac that samples": (SAC(**SMALL_SAC | WIDE, deterministic_eval=False), VECTOR),
    "sac with another activation": (SAC(**SMALL_SAC | WIDE | {"network": MLP((9,), "tanh")}), VECTOR),
    "sac of images": (SAC(**SMALL_SAC | WIDE | {"network": SMALL_MULTIMODAL}), IMAGES),
    "ppo": (PPO(**SMALL_PPO | WIDE), MEMORY),
    "ppo that samples": (PPO(**SMALL_PPO | WIDE, deterministic_eval=False), VECTOR),
    "regression": (Regression(**SMALL_REGRESSION | WIDE), VECTOR),
}


def made(algorithm, env_factory, volumes, compute=None):
    """Make an agent, and let it learn a little if it does."""
    setup = AgentSetup(
        make_envs=partial(env_factory.make_vector_env, volumes=volumes),
        observation_space=env_factory.make_env(volumes).observation_space,
        action_names=("rz", "ty"),
        total_env_steps=100,
        seed=3,
        compute=compute or Compute("cpu"),
    )
    agent = algorithm.agent(setup)
    if hasattr(agent, "learn"):
        agent.warm_up()
        agent.learn(40)
    return agent


def one_by_one(agent, env, n_episodes, seed):
    names = list(env.get_wrapper_attr("volumes"))
    return tuple(play(agent, env, names[i % len(names)], seed + i) for i in range(n_episodes))


@pytest.mark.parametrize("case", CASES)
def test_episodes_side_by_side_are_those_that_are_played_one_by_one(case, dataset):
    algorithm, env_factory = CASES[case]
    volumes = dict(list(dataset.items())[:3])
    agent, env = made(algorithm, env_factory, volumes), env_factory.make_env(volumes)
    assert evaluate(agent, env, n_episodes=10, seed=7).episodes == one_by_one(agent, env, 10, 7)


def test_more_episodes_than_side_by_side_are_played_in_turn(dataset, monkeypatch):
    agent, env = made(Random(), VECTOR, dataset), VECTOR.make_env(dataset)
    alone = one_by_one(agent, env, 8, 0)
    # Of different lengths, so that some episodes end while others go on.
    assert len({episode.n_steps for episode in alone}) > 1
    monkeypatch.setattr("armscan.training.episodes.MAX_SIDE_BY_SIDE", 3)
    assert evaluate(agent, env, n_episodes=8, seed=0).episodes == alone


def test_episodes_name_the_subject_of_their_volume(dataset):
    first, second, *_ = dataset
    volumes = {first: dataset[first].of_subject("S1"), second: dataset[second]}
    played = evaluate(made(Random(), VECTOR, volumes), VECTOR.make_env(volumes), n_episodes=2, seed=0)
    assert played.subject_of == {first: "S1", second: second}
    assert Evaluation.of_columns(played.columns()).episodes == played.episodes
    assert volumes[first].fingerprint == dataset[first].fingerprint


def test_mixed_precision_plays_the_same_side_by_side(dataset):
    agent = made(SAC(**SMALL_SAC | WIDE), VECTOR, dataset, Compute("cpu", "bfloat16"))
    env = VECTOR.make_env(dataset)
    assert evaluate(agent, env, n_episodes=6, seed=7).episodes == one_by_one(agent, env, 6, 7)


def test_evaluate_leaves_the_environment_as_it_is(dataset):
    env = MEMORY.make_env(dataset)
    before, _ = env.reset(seed=1)
    evaluate(made(Random(), MEMORY, dataset), env, n_episodes=3, seed=0)
    twin = MEMORY.make_env(dataset)
    np.testing.assert_array_equal(twin.reset(seed=1)[0], before)
    np.testing.assert_array_equal(env.step(np.zeros(2))[0], twin.step(np.zeros(2))[0])


def test_evaluate_refuses_an_environment_in_an_unknown_wrapper(dataset):
    import gymnasium as gym

    env = VECTOR.make_env(dataset)
    wrapped = gym.wrappers.TransformReward(env, lambda reward: reward)
    with pytest.raises(InvalidValueError, match=r"TransformReward.* must be an ArmscanEnv, alone or in the wrappers"):
        evaluate(made(Random(), VECTOR, dataset), wrapped, n_episodes=1, seed=0)

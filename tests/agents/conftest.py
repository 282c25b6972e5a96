"""Inputs of agents, and every algorithm with every network that fits."""

from functools import partial

import pytest

from armscan.agents import MLP, PPO, SAC, AgentSetup, Compute, Multimodal, Regression
from armscan.envs import EnvFactory, SliceChannelsObservation

SMALL_MULTIMODAL = Multimodal(filters=(2, 2, 2), vector_sizes=(8,), head_sizes=(8,))
SMALL_SAC = {"num_envs": 2, "learning_starts": 20, "batch_size": 16, "env_steps_per_collection": 4, "utd_ratio": 0.5}
SMALL_PPO = {"num_envs": 2, "env_steps_per_collection": 20, "batch_size": 10, "n_epochs": 2}
SMALL_REGRESSION = {"num_envs": 2, "batch_size": 16, "utd_ratio": 0.5, "own_planes_share": 0.5}
ALGORITHMS = {"sac": (SAC, SMALL_SAC), "ppo": (PPO, SMALL_PPO), "regression": (Regression, SMALL_REGRESSION)}
ENV_FACTORIES = {
    "vector": (EnvFactory(projection="zy"), MLP((8,))),
    "images": (
        EnvFactory(projection="zy", observation=SliceChannelsObservation(shape=(36, 36)), stack=2, memory=2),
        SMALL_MULTIMODAL,
    ),
}


def setup_for(env_factory, phantom, **changes):
    arguments = {
        "make_envs": partial(env_factory.make_vector_env, volumes=[phantom]),
        "observation_space": env_factory.make_env([phantom]).observation_space,
        "action_names": ("rz", "ty"),
        "total_env_steps": 100,
        "seed": 3,
        "compute": Compute("cpu"),
    }
    return AgentSetup(**arguments | changes)


@pytest.fixture(params=list(ALGORITHMS))
def algorithm(request):
    """Make the algorithm with a network and changed parameters."""
    kind, small = ALGORITHMS[request.param]
    return lambda network=None, **changes: kind(network=network or MLP((8,)), **small | changes)


@pytest.fixture(params=list(ENV_FACTORIES))
def factory_and_network(request):
    return ENV_FACTORIES[request.param]


@pytest.fixture
def make_learner(algorithm, factory_and_network, phantom):
    """Make a learner of every algorithm, for vectors and for images."""
    env_factory, network = factory_and_network
    return lambda **changes: algorithm(network, **changes).agent(setup_for(env_factory, phantom))


@pytest.fixture
def env(factory_and_network, phantom):
    """Return an environment that `make_learner`'s learners can act in."""
    return factory_and_network[0].make_env([phantom])

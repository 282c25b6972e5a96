"""Every choice of every configuration group can be composed, and makes an environment."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from hydra.utils import instantiate

import armscan.conf
from armscan.agents import AgentSetup, Compute

FOLDER = Path(armscan.conf.__file__).parent


def choices(group):
    return sorted(path.stem for path in (FOLDER / group).glob("*.yaml"))


@pytest.fixture(scope="module", autouse=True)
def hydra_config():
    with initialize_config_module("armscan.conf", version_base="1.3"):
        yield


def one_env(volume, *overrides):
    config = compose("config", overrides=list(overrides))
    return instantiate(config.env, _convert_="object").fitted_to({volume.name: volume}).one([volume])


@pytest.mark.parametrize("reward", choices("reward"))
@pytest.mark.parametrize("obs", choices("obs"))
def test_conf_composes_every_observation_and_reward(phantom, obs, reward):
    # A phantom's labelled plane shows four bones and three tendons.
    env = one_env(phantom, f"obs={obs}", f"reward={reward}", "env.delta=0.5")
    observed, _ = env.reset(seed=0)
    assert env.observation_space.contains(observed)


@pytest.mark.parametrize("experiment", choices("experiment"))
def test_conf_composes_every_experiment_with_an_agent_that_takes_its_observations(phantom, experiment):
    config = compose("config", overrides=[f"experiment={experiment}"])
    maker = instantiate(config.env, _convert_="object").fitted_to({phantom.name: phantom})
    env = maker.one([phantom])
    setup = AgentSetup(
        make_envs=partial(maker.many, volumes=[phantom], autoreset_mode="Disabled"),
        observation_space=env.observation_space,
        action_names=env.get_wrapper_attr("action_names"),
        total_env_steps=config.training.env_steps,
        seed=0,
        compute=Compute("cpu"),
    )
    agent = instantiate(config.agent, _convert_="object").agent(setup)
    observation, info = env.reset(seed=0)
    agent.begin(seed=0, bounds=env.get_wrapper_attr("scene").bounds)
    assert env.action_space.contains(np.float32(agent.act(observation, info["reward"])))


@pytest.mark.parametrize("clustering", ["pixels", "metric"])
@pytest.mark.parametrize("wrappers", [["stack=3"], ["memory=2"], ["stack=2", "memory=3", "stack_memory=true"]], ids=str)
def test_conf_composes_wrappers_and_clusterings(phantom, wrappers, clustering):
    env = one_env(phantom, *wrappers, f"env.clustering={clustering}", "projection=[rz,ty]")
    assert env.observation_space.contains(env.reset(seed=0)[0])


def test_conf_takes_any_combination_of_observations(phantom):
    env = one_env(phantom, "env.observation=[slice,cluster,slice_channels]", "stack=2", "stack_exclude=[slice]")
    assert list(env.observation_space) == ["action", "channels", "clusters", "reward", "slice"]
    assert env.observation_space["slice"].shape == (360, 80)
    assert env.observation_space["channels"].shape == (2, 3, 360, 80)


def test_conf_fits_the_reward_to_the_volumes_that_are_trained_on(dataset):
    first, second = list(dataset.values())[:2]
    maker = instantiate(compose("config", overrides=["reward=agreement", "env.delta=0.5"]).env, _convert_="object")
    rewards = [maker.fitted_to({volume.name: volume}).one([first]).unwrapped.task.reward for volume in (first, second)]
    landmarks = np.array([[4, 3000, 180, 40], [3, 1000, 180, 45], [1, 100, 190, 50]], dtype=float)
    scores = [reward.score(landmarks, first.pixel_mm) for reward in rewards]
    assert scores[0] != scores[1]

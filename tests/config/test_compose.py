"""Every choice of every configuration group can be composed, and makes an environment."""

import numpy as np
import pytest
from hydra.utils import instantiate

from armscan.config.compose import compose
from armscan.config.sources import config_folder
from armscan.experiment.build import build_setup
from tests.conftest import DATA
from tests.support import FEW_VOLUMES


def choices(group):
    return sorted(path.stem for path in (config_folder() / group).glob("*.yaml"))


def one_env(volume, *overrides):
    config = compose(overrides)
    return instantiate(config.env, _convert_="object").fit({volume.name: volume}).make_env([volume])


@pytest.mark.parametrize("reward", choices("reward"))
@pytest.mark.parametrize("obs", choices("obs"))
def test_conf_composes_every_observation_and_reward(phantom, obs, reward):
    # A phantom's labelled plane shows four bones and three tendons.
    env = one_env(phantom, f"obs={obs}", f"reward={reward}", "env.success_threshold=0.5")
    observed, _ = env.reset(seed=0)
    assert env.observation_space.contains(observed)


WHOLE = [f"agent={agent}" for agent in choices("agent")] + [f"experiment={name}" for name in choices("experiment")]


ONE_FOLD = [f"data.path={DATA / 'volumes'}", "data.fold=0"]
# What some agents need of the environment, and what some experiments need of their user.
BESIDE = {
    "agent=plane_finder": ["experiment=plane_finder"],
    "agent=residual_sac": ["experiment=few_wrists_sac", *ONE_FOLD],
    "experiment=few_wrists": ONE_FOLD,
    "experiment=few_wrists_sac": ONE_FOLD,
}


@pytest.mark.parametrize("override", WHOLE)
def test_conf_composes_every_agent_and_experiment(override):
    # Few phantoms are quick, even if an experiment asks for more. The threshold is loose, because a reward that is
    # fitted to one wrist alone would not accept the labelled plane of another.
    few = [*FEW_VOLUMES, "env.success_threshold=0.5"]
    experiment = build_setup(compose([override, *BESIDE.get(override, []), *few]))
    env = experiment.env_factory.make_env(experiment.split.test)
    observation, info = env.reset(seed=0)
    experiment.agent.begin(seed=0, bounds=env.get_wrapper_attr("scene").bounds)
    action = experiment.agent.act(observation, info["reward"])
    assert action.shape == env.action_space.shape
    assert np.abs(action).max() <= 1.0


def test_cluster_observation_takes_a_reward_without_targets():
    assert compose(["reward.targets=[1,2,3]"]).obs.targets == [1, 2, 3]
    config = compose(["~reward.targets"])
    assert config.obs.targets is None
    # Hydra resolves the whole section.
    assert instantiate(config.env)


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
    env_factory = instantiate(compose(["reward=agreement", "env.success_threshold=0.5"]).env, _convert_="object")
    rewards = [
        env_factory.fit({volume.name: volume}).make_env([first]).unwrapped.rules.reward for volume in (first, second)
    ]
    landmarks = np.array([[4, 3000, 180, 40], [3, 1000, 180, 45], [1, 100, 190, 50]], dtype=float)
    scores = [reward.score(landmarks, first.pixel_mm) for reward in rewards]
    assert scores[0] != scores[1]

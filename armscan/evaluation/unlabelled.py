"""Planes that an agent finds in volumes without a labelled plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

from hydra.utils import instantiate

from armscan.anatomy import FoundPlane, LandmarkReward, PlaneScorer, Tissues, check_tissues
from armscan.envs import EnvFactory
from armscan.envs.actions import COMPONENTS, free_components
from armscan.envs.rules import ON_BUDGET, ON_REWARD
from armscan.errors import InvalidValueError, listed
from armscan.evaluation.agent_source import EvaluatedAgent
from armscan.evaluation.runner import FIRST_SEED, prepare_on_volumes
from armscan.evaluation.volumes import VolumesByName, own_split
from armscan.utils.console import print_sentence
from armscan.volumes import LabelVolume, ManipulatorAction

# Places along the arm, as fractions of its length, where a plane may show something.
PLACES = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8)


def agent_search(source: EvaluatedAgent, volumes: VolumesByName) -> Callable[[LabelVolume], FoundPlane]:
    """Return a function that finds the plane of a volume by an episode of an agent.

    Args:
        source: Configuration and weights of the agent.
        volumes: Volumes that it will be called for, by name, unmoved.

    Raises:
        InvalidValueError: If components are not free, because an environment holds them at the labelled plane.
        ArmscanError: If the agent cannot be applied to the volumes; the message says why.
    """
    config = source.config.copy()
    rules = config.env
    built: EnvFactory = instantiate(rules, _convert_="object")
    free = free_components(built.rules["projection"])
    if held := [name for i, name in enumerate(COMPONENTS) if i not in free]:
        raise InvalidValueError(
            f"{source.name} moves {listed(COMPONENTS[i] for i in free)} only, and its environment holds "
            f"{listed(held)} at the labelled plane: an agent that finds planes requires projection=full"
        )
    # The environment requires a labelled plane; here any will do, and the episode is ended below.
    threshold, ends_on_reward = float(rules.success_threshold), rules.get("ends", ON_REWARD) == ON_REWARD
    rules.success_threshold, rules.transform = 1.0, None
    if ends_on_reward:
        rules.ends = ON_BUDGET
    tissues = check_tissues(built.rules.get("clustering", "pixels"))
    any_plane = {name: _with_any_plane(volume, tissues) for name, volume in volumes.items()}
    own = cache(partial(own_split, source, ("training",)))
    prepared = prepare_on_volumes(replace(source, config=config), {"volumes": any_plane}, own)
    for note in prepared.notes:
        print_sentence(f"note: {note}")
    agent, env = prepared.agent, prepared.envs["volumes"]

    def find(volume: LabelVolume) -> FoundPlane:
        observation, info = env.reset(seed=FIRST_SEED, options={"volume": volume.name})
        agent.begin(seed=FIRST_SEED, bounds=env.get_wrapper_attr("episode").scene.bounds)
        reward, ended = float(info["reward"]), False
        while not ended:
            observation, received, terminated, truncated, _ = env.step(agent.act(observation, reward))
            reward = float(received)
            ended = terminated or truncated or (ends_on_reward and reward > -threshold)
        if expected := getattr(agent, "expected_error", None):
            print_sentence("expected error {:.1f} mm, {:.1f}°".format(*expected))
        plane = env.get_wrapper_attr("episode").plane
        return FoundPlane(plane, *PlaneScorer(volume, LandmarkReward(), tissues).score(plane))

    return find


def _with_any_plane(volume: LabelVolume, tissues: Tissues) -> LabelVolume:
    """Return a volume with a plane straight across the arm, the first of `PLACES` at which clusters are seen."""
    scorer = PlaneScorer(volume, LandmarkReward(), tissues)
    planes = [ManipulatorAction((0.0, 0.0), (0.0, place * volume.size_mm[1])) for place in PLACES]
    plane = next((each for each in planes if scorer.score(each)[0] > -1.0), planes[0])
    return replace(volume, optimal_action=plane)

"""Planes that an agent finds in volumes without a labelled plane."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

from hydra.utils import instantiate

from armscan.anatomy import FoundPlane, LandmarkReward, PlaneScorer, check_tissues
from armscan.envs import EnvFactory
from armscan.envs.actions import COMPONENTS, free_components
from armscan.envs.rules import ON_BUDGET, ON_REWARD
from armscan.errors import InvalidValueError, OptimalPlaneError
from armscan.evaluation.agent_source import EvaluatedAgent
from armscan.evaluation.runner import prepare_on_volumes
from armscan.evaluation.volumes import own_split
from armscan.training.episode_seeds import EVALUATION_SEED
from armscan.utils.console import print_sentence
from armscan.volumes import LabelVolume, ManipulatorAction
from armscan.volumes.volume import palm_notes

# Values of ty, as fractions of its range, at which a plane may show something.
PLACES = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8)


class AgentSearch:
    """Finds the plane of a volume by one episode of an agent; call it with the volume.

    Args:
        source: Configuration and weights of the agent.

    Raises:
        InvalidValueError: If components are not free, because an environment holds them at the labelled plane.
    """

    def __init__(self, source: EvaluatedAgent) -> None:
        config = source.config.copy()
        rules = config.env
        built: EnvFactory = instantiate(rules, _convert_="object")
        free = free_components(built.rules["projection"])
        if held := [name for i, name in enumerate(COMPONENTS) if i not in free]:
            raise InvalidValueError(
                f"{source.name} moves {' and '.join(COMPONENTS[i] for i in free)} only, and its environment holds "
                f"{' and '.join(held)} at the labelled plane: an agent that finds planes requires projection=full"
            )
        self.tissues = check_tissues(built.rules.get("clustering", "pixels"))
        """Clustering rules of the agent's environment."""
        # The environment requires a labelled plane; here any will do, and `__call__` ends the episode.
        self._threshold = float(rules.success_threshold)
        self._ends_on_reward = rules.get("ends", ON_REWARD) == ON_REWARD
        self._bound_mm = rules.get("translation_bounds_mm")
        rules.success_threshold, rules.transform = 1.0, None
        if self._ends_on_reward:
            rules.ends = ON_BUDGET
        self._source = replace(source, config=config)
        self._own = cache(partial(own_split, source, ("training",)))

    @property
    def run_id(self) -> str | None:
        """MLflow run ID of the agent; None for an agent without a run."""
        return self._source.run.run_id if self._source.run else None

    def __call__(self, volume: LabelVolume) -> FoundPlane:
        """Return the last plane of the episode.

        Raises:
            OptimalPlaneError: If the environment sees nothing at any of `PLACES`.
            ArmscanError: If the agent cannot be applied to the volume; the message says why.
        """
        volumes = {volume.name: self._with_any_plane(volume)}
        prepared = prepare_on_volumes(self._source, {volume.name: volumes}, self._own)
        for note in (*prepared.notes, *palm_notes(volumes)):
            print_sentence(f"note: {note}")
        agent, env = prepared.agent, prepared.envs[volume.name]
        observation, info = env.reset(seed=EVALUATION_SEED)
        agent.begin(seed=EVALUATION_SEED, bounds=env.get_wrapper_attr("episode").scene.bounds)
        reward, ended = float(info["reward"]), False
        while not ended:
            observation, received, terminated, truncated, _ = env.step(agent.act(observation, reward))
            reward = float(received)
            ended = terminated or truncated or (self._ends_on_reward and reward > -self._threshold)
        if expected := getattr(agent, "expected_error", None):
            print_sentence("expected error {:.1f} mm, {:.1f}°".format(*expected))
        plane = env.get_wrapper_attr("episode").plane
        return FoundPlane(plane, *self._scorer(volume).score(plane))

    def _scorer(self, volume: LabelVolume) -> PlaneScorer:
        return PlaneScorer(volume, LandmarkReward(), self.tissues)

    def _with_any_plane(self, volume: LabelVolume) -> LabelVolume:
        """Return the volume with a plane straight across the arm, the first of `PLACES` at which clusters are seen."""
        along_mm = volume.size_mm[1] if self._bound_mm is None else min(volume.size_mm[1], self._bound_mm[1])
        scorer = self._scorer(volume)
        for place in PLACES:
            plane = ManipulatorAction((0.0, 0.0), (0.0, place * along_mm))
            if scorer.score(plane)[0] > -1.0:
                return replace(volume, optimal_action=plane)
        raise OptimalPlaneError(f"{volume.name}: the agent's environment sees nothing at {len(PLACES)} values of ty")

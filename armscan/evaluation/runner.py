"""Evaluate an agent on volumes: compatibility checks, notes on differences, episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from textwrap import shorten

from omegaconf import DictConfig

from armscan.agents import Agent, Learner
from armscan.anatomy import USUAL_PIXEL_MM
from armscan.config.command_hints import resume_command
from armscan.envs import EnvFactory
from armscan.errors import CheckpointError, InvalidValueError, OptimalPlaneError, listed
from armscan.evaluation.agent_source import TrainedAgent
from armscan.evaluation.volumes import Volumes
from armscan.experiment.build import apply_crop, make_agent, make_env_factory
from armscan.tracking import FoundRun
from armscan.training import Evaluation, TrainingDomain, evaluate
from armscan.training.domain import smallest_slice
from armscan.training.rollout import Env
from armscan.volumes import LabelVolume

# First seed of an evaluation's episodes: none of them is played by a run, whose seeds lie below.
FIRST_SEED = 5 * 10**6
PIXEL_TOLERANCE = 0.1
MAX_REASON_CHARS = 250


@dataclass(frozen=True)
class AgentEvaluator:
    """An agent and the environments that it is evaluated in.

    Args:
        agent: with its weights.
        envs: by what their volumes are called.
        notes: differences from the training domain, a sentence each.
    """

    agent: Agent
    envs: dict[str, Env]
    notes: tuple[str, ...]

    def evaluate(
        self, n_episodes: int, seed: int, tell: Callable[[str], None] = lambda _: None
    ) -> dict[str, Evaluation]:
        """Return the episodes, `n_episodes` for each environment, in turn on its volumes; `tell` hears how it goes."""
        evaluations = {}
        for label, env in self.envs.items():
            tell(f"playing {n_episodes} episodes on {len(env.get_wrapper_attr('volumes'))} {label}")
            evaluations[label] = evaluate(self.agent, env, n_episodes=n_episodes, seed=FIRST_SEED + seed)
        return evaluations


def prepare(
    subject: TrainedAgent,
    groups: Mapping[str, Volumes],
    training: Mapping[str, LabelVolume],
    *,
    render_mode: str | None = None,
) -> AgentEvaluator:
    """Make the agent and its environments on the volumes that it is evaluated on.

    Args:
        subject: the agent's configuration and weights.
        groups: the volumes, by what they are called.
        training: the volumes that the agent was trained on; looked at only where its reward is fitted to them.
        render_mode: Gymnasium render mode of the environments; default: None.

    Raises:
        ArmscanError: if the agent cannot be applied to the volumes; the reason is said.
    """
    envs: dict[str, Env] = {}
    notes: list[str] = []
    trained = subject.domain
    agent = None
    for label, volumes in groups.items():
        config = subject.config if trained is None else _seen_as_trained(subject.config, trained, volumes)
        maker = make_env_factory(config, training)
        envs[label] = _env(maker, volumes, config.env.clustering, render_mode)
        here = TrainingDomain.of(envs[label])
        if subject.domain is not None:
            notes += [f"{label}: {difference}" for difference in subject.domain.differences(here)]
        # Of a run that has not kept what its agent was trained on, all volumes must at least look alike.
        trained = trained or here
        trained.check_observed(here)
        if agent is None:
            budget = int(config.training.env_steps)
            agent = make_agent(config, maker, volumes, total_env_steps=budget, seed=int(config.seed))
            _load_weights(agent, subject)
    assert agent is not None
    return AgentEvaluator(agent, envs, tuple(notes))


def _seen_as_trained(config: DictConfig, trained: TrainingDomain, volumes: Volumes) -> DictConfig:
    """Return the configuration with images cropped as they were in training."""
    return apply_crop(config, trained.slice_px, smallest_slice(volumes.values()))


def _env(maker: EnvFactory, volumes: Volumes, clustering: object, render_mode: str | None) -> Env:
    try:
        return maker.one(volumes, render_mode=render_mode)
    except OptimalPlaneError as error:
        sizes = {volume.pixel_mm for volume in volumes.values()}
        is_usual = all(
            abs(mm / usual - 1) <= PIXEL_TOLERANCE
            for size in sizes
            for mm, usual in zip(size, USUAL_PIXEL_MM, strict=True)
        )
        if clustering != "pixels" or is_usual:
            raise
        shown = listed(f"{across:.3g} x {depth:.3g}" for across, depth in sorted(sizes))
        raise InvalidValueError(
            f"{error}; clusters are found by pixels, as suits about 0.27 x 0.55 mm, and here a pixel has {shown} mm: "
            "unless the plane is wrong, --clustering metric may see them"
        ) from error


def _load_weights(agent: Agent, subject: TrainedAgent) -> None:
    if not isinstance(agent, Learner):
        return
    if subject.run is None:
        raise InvalidValueError(f"{subject.name} has to be trained first: give the RUN that has trained one")
    if subject.weights is None:
        raise CheckpointError(_without_checkpoint(subject.run))
    try:
        agent.load_weights(subject.weights)
    except CheckpointError as error:
        # torch lists every name that it misses, and every one that it does not know.
        raise CheckpointError(f"run {subject.run.run_id}: {shorten(str(error), MAX_REASON_CHARS)}") from error


def _without_checkpoint(run: FoundRun) -> str:
    if run.status == "FINISHED":
        return f"run {run.run_id} has kept no checkpoint, so that there is nothing to evaluate"
    ended = "is still running, or was killed" if run.status == "RUNNING" else f"ended before its time ({run.status})"
    return (
        f"run {run.run_id} {ended}, and a run keeps its checkpoint in the store at its end: go on with it by "
        f"{resume_command(run.run_id, run.uri)}"
    )

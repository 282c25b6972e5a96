"""Evaluate an agent on volumes: compatibility checks, notes on differences, episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial

from armscan.agents import Agent, Learner
from armscan.anatomy import USUAL_PIXEL_MM
from armscan.anatomy.tissues import MAX_METRIC_PIXEL_MM
from armscan.config.command_hints import resume_command
from armscan.config.defaults import PHANTOM, to_plain
from armscan.envs import EnvFactory
from armscan.errors import CheckpointError, InvalidValueError, OptimalPlaneError, listed, printable, reason_of
from armscan.evaluation.agent_source import EvaluatedAgent
from armscan.evaluation.volumes import (
    TrainingVolumes,
    VolumesByName,
    are_known,
    known_volumes,
    notes_on_planes,
    own_split,
    phantom_version,
    volume_groups,
)
from armscan.experiment.agent import make_agent
from armscan.experiment.build import apply_crop, make_env_factory, on_plane_of
from armscan.tracking import FoundRun
from armscan.training import PARTS, Evaluation, Split, TrainingDomain, evaluate, evaluate_baselines
from armscan.training.domain import smallest_slice
from armscan.training.episode_results import Env
from armscan.training.episode_seeds import EVALUATION_SEED
from armscan.utils.console import print_sentence
from armscan.utils.text import counted
from armscan.volumes.dataset import check_copies
from armscan.volumes.volume import palm_notes

PIXEL_TOLERANCE = 0.1


@dataclass(frozen=True)
class PreparedAgent:
    """An agent that is ready to play on volumes.

    Args:
        source: Configuration and weights of the agent.
        agent: Agent with its weights.
        envs: Environments by the name of their volumes.
        notes: Differences from its training, one sentence each.
        data: Folder of the volumes, `phantom`, or None for the volumes of the agent's own configuration.
        is_new: Whether the agent's run has used neither the volumes nor others of their names or subjects.
            Default: False.
        own: Names of those environments that have volumes which the agent's run has used, by their contents. Default:
            none.
    """

    source: EvaluatedAgent
    agent: Agent
    envs: dict[str, Env]
    notes: tuple[str, ...]
    data: str | None = None
    is_new: bool = False
    own: tuple[str, ...] = ()

    def evaluate(
        self, n_episodes: int, seed: int, tell: Callable[[str], None] = lambda _: None
    ) -> tuple[dict[str, Evaluation], dict[str, dict[str, Evaluation]]]:
        """Play episodes, `n_episodes` for each environment, in turn on its volumes.

        Args:
            n_episodes: Number of episodes.
            seed: Seed of the evaluation: episode i is reset with 5,000,000 + seed + i.
            tell: Function that receives the progress. Default: none.

        Returns:
            The agent's episodes, by the name of their volumes; and the same for each baseline, by its name.
        """
        evaluations: dict[str, Evaluation] = {}
        baselines: dict[str, dict[str, Evaluation]] = {}
        on_plane = on_plane_of(self.source.config)
        for label, env in self.envs.items():
            n_volumes = len(env.get_wrapper_attr("volumes"))
            tell(f"playing {counted(n_episodes, 'episode')} on {label} ({counted(n_volumes, 'volume')})")
            how = {"n_episodes": n_episodes, "seed": EVALUATION_SEED + seed}
            evaluations[label] = evaluate(self.agent, env, **how, on_plane=on_plane)
            for name, evaluation in evaluate_baselines(env, **how, on_plane=on_plane).items():
                baselines.setdefault(name, {})[label] = evaluation
        return evaluations, baselines


def prepare_agent(
    source: EvaluatedAgent,
    data: str | None,
    n_phantoms: int,
    *,
    check: Callable[[Mapping[str, VolumesByName]], None] = lambda _: None,
    render_mode: str | None = None,
) -> PreparedAgent:
    """Prepare an agent for volumes, and print the differences from its training.

    Args:
        source: Agent to apply.
        data: Folder of volumes, `phantom` for new phantoms of the version in the agent's configuration, or None for
            the volumes of that configuration.
        n_phantoms: Number of phantoms, 1 or more; used for `phantom` only.
        check: Function that raises an error if the groups of volumes, by name, do not suit the caller.
        render_mode: Gymnasium render mode of the environments. Default: None.

    Raises:
        ArmscanError: If volumes are missing or damaged, or the agent cannot be applied to them.
    """
    # On other volumes, only the training volumes matter among its own: the reward is fitted to them.
    parts = ("training",) if data else PARTS
    own = cache(partial(own_split, source, parts))
    groups = volume_groups(data, n_phantoms, own, phantom_version(source))
    for volumes in groups.values():
        check_copies(volumes)
    check(groups)
    prepared = prepare_on_volumes(source, groups, own, render_mode=render_mode)
    notes = list(prepared.notes)
    if data not in (None, PHANTOM):
        notes += palm_notes({name: volume for of_group in groups.values() for name, volume in of_group.items()})
        notes += notes_on_planes(data, source.run.run_id if source.run else None)
    is_elsewhere = bool(data and source.run)
    known = known_volumes(source, groups) if is_elsewhere else []
    own_groups = [label for label, volumes in groups.items() if is_elsewhere and are_known(source, volumes)]
    notes += [*known, *([source.code_note] if source.code_note else [])]
    if source.run and source.volumes is None and own.cache_info().currsize:
        notes.append("the run has no fingerprints of its volumes, so these may have changed since")
    for note in notes:
        print_sentence(printable(f"note: {note}"))
    is_new = data is not None and not known
    return replace(prepared, notes=tuple(notes), data=data, is_new=is_new, own=tuple(own_groups))


def prepare_on_volumes(
    source: EvaluatedAgent,
    groups: Mapping[str, VolumesByName],
    own: Callable[[], Split],
    *,
    render_mode: str | None = None,
) -> PreparedAgent:
    """Make the agent and its environments on the volumes that it is evaluated on.

    Args:
        source: Configuration and weights of the agent.
        groups: Volumes by the name of their group.
        own: Function that reads the agent's own volumes; called only if its reward is fitted to its training volumes.
        render_mode: Gymnasium render mode of the environments. Default: None.

    Raises:
        ArmscanError: If the agent cannot be applied to the volumes; the message says why.
    """
    envs: dict[str, Env] = {}
    notes: list[str] = []
    trained = source.domain
    agent = None
    for label, volumes in groups.items():
        config = source.config
        if trained is not None:
            config = apply_crop(config, trained.slice_px, smallest_slice(volumes.values()))
        env_factory = make_env_factory(config, TrainingVolumes(own))
        envs[label] = _env(env_factory, volumes, config.env.clustering, render_mode)
        here = TrainingDomain.of(envs[label])
        if source.domain is not None:
            rules = to_plain(source.config.env)
            found = source.domain.differences(
                here, rules.get("observation"), is_bounded=rules.get("translation_bounds_mm") is not None
            )
            notes += [f"{label}: {difference}" for difference in found]
        # If a run has no training domain, the groups of volumes must at least match each other.
        trained = trained or here
        trained.check_observed(here)
        if agent is None:
            budget = int(config.training.env_steps)
            agent = make_agent(config, env_factory, volumes, total_env_steps=budget, seed=int(config.seed))
            _load_weights(agent, source)
    assert agent is not None
    return PreparedAgent(source, agent, envs, tuple(notes))


def _env(env_factory: EnvFactory, volumes: VolumesByName, clustering: object, render_mode: str | None) -> Env:
    try:
        return env_factory.undeformed().make_env(volumes, render_mode=render_mode)
    except OptimalPlaneError as error:
        sizes = {volume.pixel_mm for volume in volumes.values()}
        is_usual = all(
            abs(mm / usual - 1) <= PIXEL_TOLERANCE
            for size in sizes
            for mm, usual in zip(size, USUAL_PIXEL_MM, strict=True)
        )
        if clustering != "pixels" or is_usual:
            raise
        can_be_metric = max(map(max, sizes)) <= MAX_METRIC_PIXEL_MM
        usual, *shown = (f"{across:.3g} x {depth:.3g}" for across, depth in (USUAL_PIXEL_MM, *sorted(sizes)))
        raise InvalidValueError(
            f"{error}; clusters are found by pixels, as suits about {usual} mm, and here a pixel has {listed(shown)} "
            "mm: unless the plane is wrong, "
            + ("--clustering metric may see them" if can_be_metric else "volumes that the manifest resamples show them")
        ) from error


def _load_weights(agent: Agent, source: EvaluatedAgent) -> None:
    if not isinstance(agent, Learner):
        return
    if source.run is None:
        raise InvalidValueError(f"{source.name} has to be trained first: give the RUN that has trained one")
    if source.weights is None:
        raise CheckpointError(_without_checkpoint(source.run))
    try:
        agent.load_weights(source.weights)
    except CheckpointError as error:
        # torch lists every missing and every unexpected name.
        raise CheckpointError(f"run {source.run.run_id}: {reason_of(error)}") from error


def _without_checkpoint(run: FoundRun) -> str:
    if run.status == "FINISHED":
        return f"run {run.run_id} stored no checkpoint: nothing to evaluate"
    ended = "is still running, or was killed" if run.status == "RUNNING" else f"ended before its time ({run.status})"
    return (
        f"run {run.run_id} {ended}, and a run keeps its checkpoint in the store at its end: resume it with "
        f"{resume_command(run.run_id, run.uri, trust=run.needs_trust)}"
    )

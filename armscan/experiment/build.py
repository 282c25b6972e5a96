"""Build an experiment from its configuration and check it before anything is trained or tracked."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from hydra.utils import get_method, instantiate
from omegaconf import DictConfig, OmegaConf

from armscan.agents import (
    Agent,
    Compute,
    Learner,
    scheduled_algorithms,
)
from armscan.config.compose import build_section
from armscan.config.defaults import CLUSTER, to_plain
from armscan.config.own_code import own_code
from armscan.config.trust import needs_trust
from armscan.envs import EnvFactory
from armscan.errors import InvalidValueError, listed
from armscan.experiment.agent import make_agent, make_algorithm
from armscan.stats.on_plane import ON_PLANE, ON_PLANE_KEY, OnPlane, check_on_plane
from armscan.tracking import TrackingSettings
from armscan.training import Budget, CheckpointProvenance, Fingerprints, Split, TrainingDomain
from armscan.training.domain import smallest_slice, with_crops
from armscan.training.episode_results import Env
from armscan.utils.log import silence_libraries
from armscan.utils.validation import check_int, check_seed
from armscan.volumes import LabelVolume

SECTIONS = ("data", "obs", "reward", "agent", "network", "tracking", "env", "training", "evaluation", "compute")
SINGLE_KEYS = ("projection", "stack", "memory", "stack_exclude", "stack_memory", "seed", "device")
EVALUATION_KEYS = ("episodes", "on_plane")


@dataclass(frozen=True, kw_only=True)
class RunSetup:
    """The parts of a run, built from its configuration.

    Args:
        split: Volumes by split.
        env_factory: Factory of environments, with the reward fitted to the training volumes.
        agent: Agent, which may be a learner.
        budget: Budget of the training.
        n_episodes: Number of episodes of each final evaluation.
        on_plane: Limits within which a plane counts as the labelled one.
        seed: Seed of the environments, networks and replay buffer; those of evaluations are derived from it.
        smallest_slice_px: Largest shape (across, depth) in pixels that fits into all slices; images of every
            split are cropped to it by default.
        needs_trust: Whether its configuration names classes that are not armscan's.
        own_code: Checksums of the modules of own classes, by their names.
    """

    split: Split
    env_factory: EnvFactory
    agent: Agent
    budget: Budget
    n_episodes: int
    on_plane: tuple[OnPlane, ...]
    seed: int
    smallest_slice_px: tuple[int, int]
    needs_trust: bool
    own_code: Mapping[str, str]

    @cached_property
    def training_env(self) -> Env:
        """Return the environment of the training volumes, for the final evaluation."""
        return self.env_factory.undeformed().make_env(self.split.training)

    @cached_property
    def validation_env(self) -> Env:
        """Return the environment of the validation volumes, for the validation after each epoch."""
        return self.env_factory.undeformed().make_env(self.split.validation)

    @cached_property
    def test_env(self) -> Env:
        """Return the environment of the test volumes, for the final evaluation."""
        return self.env_factory.undeformed().make_env(self.split.test)

    @cached_property
    def video_env(self) -> Env:
        """Return the environment of the test volumes, for the video of an episode."""
        return self.env_factory.undeformed().make_env(self.split.test, render_mode="rgb_array")

    @cached_property
    def fingerprints(self) -> Fingerprints:
        """Return the fingerprints of the volumes; computed once, because a hundred volumes take a second."""
        return self.split.fingerprints()

    def provenance(self, run_id: str) -> CheckpointProvenance:
        """Return the provenance written into the checkpoints of a run."""
        return CheckpointProvenance(run_id=run_id, volumes=self.fingerprints)


def set_up(config: DictConfig) -> RunSetup:
    """Build the setup of a run with the environments of its evaluations, and check them, before tracking starts.

    Raises:
        InvalidValueError: If a value is not allowed, or the agent cannot act in one of the environments.
    """
    silence_libraries()
    setup = build_setup(config)
    envs = (setup.training_env, setup.validation_env, setup.test_env, setup.video_env)
    trained = TrainingDomain.of(envs[0])
    for env in envs[1:]:
        trained.check_observed(TrainingDomain.of(env))
    if not isinstance(setup.agent, Learner):
        # Checks the number of planes of a sweep, which depends on the sizes of the volumes.
        for bounds in {bounds for env in envs for bounds in env.get_wrapper_attr("rules").bounds.values()}:
            setup.agent.begin(seed=0, bounds=bounds)
    return setup


def build_setup(config: DictConfig, split: Split | None = None) -> RunSetup:
    """Build the setup of a run.

    Args:
        config: Composed configuration of the run.
        split: Its volumes. Default: None, they are read.

    Raises:
        ArmscanError: If the configuration or a volume is refused.
    """
    check_config(config)
    # As they are loaded: the files may be edited while the volumes are read.
    own_modules = own_code(to_plain(config))
    budget = build_section(config, "training", Budget)
    split = split or build_section(config, "data", Split)
    smallest = smallest_slice(volume for part in split.parts.values() for volume in part.values())
    env_factory = make_env_factory(apply_crop(config, smallest, smallest), split.training)
    agent = make_agent(
        config,
        env_factory,
        split.training,
        total_env_steps=budget.env_steps,
        seed=config.seed,
        validation=split.validation,
        schedule=budget.segments,
    )
    return RunSetup(
        split=split,
        env_factory=env_factory,
        agent=agent,
        budget=budget,
        n_episodes=config.evaluation.episodes,
        on_plane=on_plane_of(config),
        seed=config.seed,
        smallest_slice_px=smallest,
        needs_trust=needs_trust(to_plain(config)),
        own_code=own_modules,
    )


def check_episodes(setup: RunSetup) -> None:
    """Check that a new run validates and tests on each of its volumes.

    Raises:
        InvalidValueError: If it has fewer episodes than volumes.
    """
    check_each_seen("evaluation.episodes", setup.n_episodes, "test", setup.split)
    if isinstance(setup.agent, Learner):
        budget = setup.budget
        check_each_seen("training.validation_episodes", budget.validation_episodes, "validation", setup.split)


def check_each_seen(key: str, n_episodes: int, part: str, split: Split) -> None:
    """Check that each volume of a part of a split has an episode.

    Args:
        key: Key of the configuration that sets the number of episodes, for errors.
        n_episodes: Number of episodes.
        part: Part of the split, such as `validation`.
        split: Volumes of the run.

    Raises:
        InvalidValueError: If there are fewer episodes than volumes.
    """
    n_volumes = len(split.parts[part])
    if n_episodes < n_volumes:
        least = f"at least {n_volumes}: one for each {part} volume"
        raise InvalidValueError(f"{key} is {n_episodes}, but it must be {least}")


def check_config(config: DictConfig) -> None:
    """Check all that can be checked before a volume is read or a learning library is loaded.

    Raises:
        InvalidValueError: If a value is not allowed.
        MissingMandatoryValue: If a mandatory value is missing.
    """
    check_sections(config)
    to_plain(config)
    _check_data(config.data)
    check_seed("seed", config.seed)
    check_int("evaluation.episodes", config.evaluation.episodes, at_least=1)
    on_plane_of(config)
    budget = build_section(config, "training", Budget)
    build_section(config, "compute", Compute)
    instantiate(config.env, _convert_="object")
    scheduled_algorithms(make_algorithm(config), budget.segments)


def _check_data(data: DictConfig) -> None:
    """Raise `InvalidValueError` for a key that this choice of `data` does not take, as presets for another may set."""
    target = str(data.get("_target_"))
    # The function of a user may take any.
    if not target.startswith("armscan."):
        return
    takes = inspect.signature(get_method(target)).parameters
    if any(each.kind is each.VAR_KEYWORD for each in takes.values()):
        return
    if unknown := [f"data.{key}" for key in map(str, data) if not key.startswith("_") and key not in takes]:
        left_out = " ".join(f"'~{key}'" for key in unknown)
        raise InvalidValueError(
            f"{unknown[0]} is set, but this data has no such key, only {listed(takes)}. If an experiment or a sweep "
            f"sets it for another choice of data, leave it out: {left_out}"
        )


def on_plane_of(config: DictConfig) -> tuple[OnPlane, ...]:
    """Return the limits within which a plane counts as the labelled one; the default limits for older runs."""
    node = config.evaluation.get("on_plane", ON_PLANE)
    return check_on_plane(ON_PLANE_KEY, OmegaConf.to_container(node) if OmegaConf.is_config(node) else node)


def apply_crop(config: DictConfig, trained_px: tuple[int, int], here_px: tuple[int, int]) -> DictConfig:
    """Return the configuration with images cropped alike on all volumes; see `with_crops`.

    Args:
        config: Configuration of the run.
        trained_px: Smallest slice that the agent was trained on, (across, depth) in pixels.
        here_px: Smallest slice of the volumes at hand, likewise.
    """
    node = config.env.observation
    rules = OmegaConf.to_container(node) if OmegaConf.is_config(node) else node
    cropped = config.copy()
    cropped.env.observation = with_crops(rules, trained_px, here_px)
    return cropped


def make_env_factory(config: DictConfig, training: Mapping[str, LabelVolume]) -> EnvFactory:
    """Return the factory of environments, its reward fitted to the training volumes."""
    env_factory: EnvFactory = instantiate(config.env, _convert_="object")
    return env_factory.fit(training)


def check_keys(config: DictConfig) -> None:
    """Raise `InvalidValueError` if a key was added that nothing reads.

    Sections that Hydra instantiates refuse such keys themselves.
    """
    check_sections(config)
    for node, where, allowed in (
        (config, "at the top", (*SECTIONS, *SINGLE_KEYS, CLUSTER)),
        (config.evaluation, "in evaluation", EVALUATION_KEYS),
    ):
        if unread := [key for key in node if key not in allowed]:
            raise InvalidValueError(f"there is no key {unread[0]!r} {where}, but only {listed(allowed)}")
    TrackingSettings.read("tracking", to_plain(config.tracking))


def check_sections(config: DictConfig) -> None:
    """Raise `InvalidValueError` if a whole section of the configuration was replaced by a value."""
    for section in SECTIONS:
        if not isinstance(config.get(section), DictConfig):
            raise InvalidValueError(
                f"{section} is {config.get(section)!r}, but it must be a section of the configuration"
            )

"""The agent of an experiment, built from its configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, cast

from hydra.utils import instantiate
from omegaconf import DictConfig

from armscan.agents import (
    Agent,
    AgentSetup,
    Algorithm,
    Compute,
    Learner,
    ScheduledLearner,
    Segment,
    VectorEnvFactory,
    scheduled_algorithms,
)
from armscan.config.compose import build_section
from armscan.envs import EnvFactory
from armscan.errors import InvalidValueError, listed
from armscan.utils.validation import missing_members
from armscan.volumes import LabelVolume


def make_agent(
    config: DictConfig,
    env_factory: EnvFactory,
    volumes: Mapping[str, LabelVolume],
    *,
    total_env_steps: int,
    seed: int,
    validation: Mapping[str, LabelVolume] | None = None,
    schedule: Sequence[Segment] = (),
) -> Agent:
    """Return the agent, which has learned nothing yet, for environments on these volumes.

    Args:
        config: Composed configuration.
        env_factory: Factory of its environments.
        volumes: Volumes to learn on.
        total_env_steps: Budget of its training, in environment steps.
        seed: Seed of all its random numbers.
        validation: Validation volumes of its training. Default: None, for an agent that does not learn.
        schedule: Changes of its hyperparameters while it learns. Default: none.
    """
    algorithm = make_algorithm(config)
    env = env_factory.make_env(dict(volumes))
    setup = AgentSetup(
        make_envs=_vector_envs(env_factory, volumes),
        observation_space=env.observation_space,
        action_names=env.get_wrapper_attr("action_names"),
        total_env_steps=total_env_steps,
        seed=seed,
        compute=build_section(config, "compute", Compute).for_space(env.observation_space),
        n_steps=env.get_wrapper_attr("rules").n_steps,
        make_validation_envs=None if validation is None else _vector_envs(env_factory.undeformed(), validation),
    )
    agent = algorithm.agent(setup)
    _check_agent(agent, algorithm)
    # All of them now, so that errors come before anything is trained.
    later: list[tuple[int, Any]] = [
        (start, each.agent(setup)) for start, each in scheduled_algorithms(algorithm, schedule)
    ]
    return ScheduledLearner(cast(Learner, agent), later) if later else agent


def _vector_envs(env_factory: EnvFactory, volumes: Mapping[str, LabelVolume]) -> VectorEnvFactory:
    """Return a factory of vector environments on these volumes, without autoreset."""
    return partial(env_factory.make_vector_env, volumes=dict(volumes))


def _check_agent(agent: Agent, algorithm: Algorithm) -> None:
    """Raise `InvalidValueError` if an agent lacks methods of `Agent`, or learns, but lacks those of `Learner`."""
    if not all(callable(getattr(agent, name, None)) for name in ("begin", "act")):
        raise InvalidValueError(
            f"{type(algorithm).__name__}.agent returned {agent!r}, but it must return an object with the methods "
            "begin and act"
        )
    if hasattr(agent, "learn") and not isinstance(agent, Learner):
        raise InvalidValueError(
            f"agent is {type(agent).__name__}, which learns, but it must have all methods of Learner: it has no "
            f"{listed(missing_members(agent, Learner))}"
        )


def make_algorithm(config: DictConfig) -> Algorithm:
    """Return the algorithm that makes the agent.

    Raises:
        InvalidValueError: If the section `agent` describes no algorithm, or a hyperparameter is not allowed.
    """
    algorithm: Algorithm = instantiate(config.agent, _convert_="object")
    if not callable(getattr(algorithm, "agent", None)):
        raise InvalidValueError(
            f"agent is {algorithm!r}, but it has no method agent: agent._target_ must name an Algorithm"
        )
    return algorithm

"""The `AgentSetup` of benchmarks that build an agent without a configuration."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from armscan.agents import AgentSetup, Compute
from armscan.envs import EnvFactory
from armscan.volumes import LabelVolume


def agent_setup(
    env_factory: EnvFactory,
    volumes: Mapping[str, LabelVolume],
    total_env_steps: int,
    compute: Compute | None = None,
) -> AgentSetup:
    """Return the setup of an agent with seed 0; without `compute`, on the CPU."""
    env = env_factory.make_env(volumes)
    return AgentSetup(
        make_envs=partial(env_factory.make_vector_env, volumes=volumes),
        observation_space=env.observation_space,
        action_names=env.get_wrapper_attr("action_names"),
        total_env_steps=total_env_steps,
        seed=0,
        compute=compute or Compute("cpu"),
    )

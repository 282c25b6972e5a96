"""What the rest of the project expects of an agent, whoever implements it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from gymnasium import spaces
from gymnasium.vector import VectorEnv

from armscan.envs.task import Observed
from armscan.volumes.plane import FloatArray

VectorEnvMaker = Callable[[int], VectorEnv[Any, Any, Any]]


class Agent(Protocol):
    """Whoever chooses planes."""

    def act(self, observation: Observed) -> FloatArray:
        """Returns the action, shape (n_free,), for one observation, as it is judged: without exploration."""


class Learner(Agent, Protocol):
    """An agent that learns, a stretch of environment steps at a time."""

    @property
    def n_env_steps(self) -> int:
        """Environment steps taken so far, all of them counted."""

    def warm_up(self) -> None:
        """Takes the steps that come before the first update."""

    def learn(self, n_env_steps: int) -> dict[str, float]:
        """Learns for `n_env_steps`, or as few more as its environments allow; returns its training metrics by name."""

    def state(self) -> dict[str, Any]:
        """Returns what a checkpoint keeps: tensors, numbers, texts, lists and dicts of them."""

    def load_state(self, state: dict[str, Any]) -> None:
        """Takes over what `state` returned."""


@dataclass(frozen=True, kw_only=True)
class LearningSetup:
    """What every learning algorithm is given beside its own parameters.

    Args:
        make_envs: makes as many training environments as are asked for, without autoreset.
        observation_space: of one of them.
        total_env_steps: environment steps that training may take.
        seed: of everything drawn.
        device: torch device.
    """

    make_envs: VectorEnvMaker
    observation_space: spaces.Space[Any]
    total_env_steps: int
    seed: int
    device: str


class LearningAlgorithm(Protocol):
    """An algorithm with its parameters, from which learners are made."""

    def learner(self, setup: LearningSetup) -> Learner:
        """Makes an agent that has learned nothing yet."""

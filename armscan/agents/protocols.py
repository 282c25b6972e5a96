"""What the rest of the project expects of an agent, whoever implements it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym

from armscan.envs.observations import FloatVector
from armscan.volumes.plane import FloatArray

EnvMaker = Callable[[], gym.Env[FloatVector, FloatArray]]


class Agent(Protocol):
    """Whoever chooses planes."""

    def act(self, observation: FloatVector) -> FloatArray:
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
        make_env: makes one training environment.
        total_env_steps: environment steps that training may take.
        seed: of everything drawn.
        device: torch device.
    """

    make_env: EnvMaker
    total_env_steps: int
    seed: int
    device: str


class LearningAlgorithm(Protocol):
    """An algorithm with its parameters, from which learners are made."""

    def learner(self, setup: LearningSetup) -> Learner:
        """Makes an agent that has learned nothing yet."""

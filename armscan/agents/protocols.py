"""What the rest of the project expects of an agent, whoever implements it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from gymnasium import spaces
from gymnasium.vector import VectorEnv

from armscan.agents.compute import Compute
from armscan.agents.policy import Policy
from armscan.envs.actions import ActionBounds
from armscan.envs.task import Observed
from armscan.volumes.plane import FloatArray

VectorEnvMaker = Callable[[int], VectorEnv[Any, Any, Any]]


class Agent(Protocol):
    """Whoever chooses planes, one episode after another."""

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Learns that an episode begins.

        Args:
            seed: whatever the agent draws in this episode comes from it.
            bounds: what the action's components stand for on the episode's volume.
        """

    def act(self, observation: Observed, reward: float) -> FloatArray:
        """Returns the next action, shape (n_free,), within [-1, 1], as it is judged: without exploration.

        Args:
            observation: of the current plane.
            reward: of the current plane, which is the start's before the first action.
        """


@runtime_checkable
class Learner(Agent, Protocol):
    """An agent that learns, a stretch of environment steps at a time."""

    @property
    def n_env_steps(self) -> int:
        """Environment steps taken so far, all of them counted."""

    @property
    def env_steps_at_once(self) -> int:
        """The fewest environment steps that `learn` can take."""

    def warm_up(self) -> None:
        """Takes the steps that come before the first update; called once, at the very beginning."""

    def learn(self, n_env_steps: int) -> dict[str, float]:
        """Learns for `n_env_steps`, or as few more as its environments allow; returns its training metrics by name."""

    def policy(self) -> Policy:
        """Returns a copy of what `act` computes with, for batches of observations; later learning leaves it alone."""

    def weights(self) -> dict[str, Any]:
        """Returns what `act` needs: tensors by name."""

    def load_weights(self, weights: dict[str, Any]) -> None:
        """Takes over what `weights` returned."""

    def state(self) -> dict[str, Any]:
        """Returns all that going on needs, the weights among it: tensors, numbers, texts, lists and dicts of them.

        An agent that takes it over goes on bit for bit as this one does.
        """

    def load_state(self, state: dict[str, Any]) -> None:
        """Takes over what `state` returned."""


@dataclass(frozen=True, kw_only=True)
class AgentSetup:
    """What every agent is given beside its own parameters.

    Args:
        make_envs: makes as many training environments as are asked for, without autoreset.
        observation_space: of one of them.
        action_names: the free components of an action, in its order, such as `("rz", "ty")`.
        total_env_steps: environment steps that training may take.
        seed: of everything drawn.
        compute: where and how tensors are computed.
    """

    make_envs: VectorEnvMaker
    observation_space: spaces.Space[Any]
    action_names: tuple[str, ...]
    total_env_steps: int
    seed: int
    compute: Compute


class Algorithm(Protocol):
    """A kind of agent with its parameters, from which agents are made."""

    def agent(self, setup: AgentSetup) -> Agent:
        """Makes an agent; a `Learner` has learned nothing yet."""

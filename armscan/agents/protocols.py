"""Interfaces of agents, learners and algorithms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from gymnasium import spaces
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from armscan.agents.compute import Compute
from armscan.envs.actions import ActionBounds
from armscan.envs.rules import Observed

if TYPE_CHECKING:
    from armscan.agents.policy import Policy

VectorEnvFactory = Callable[[int], VectorEnv[Any, Any, Any]]


class Agent(Protocol):
    """Chooses planes, one episode after another.

    Of episodes side by side, each is played by a shallow copy of the agent, unless it is a `BatchAgent` too.
    """

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin an episode; assign all of its state anew, so that copies do not share it.

        Args:
            seed: Seed of the agent's random numbers in this episode.
            bounds: Ranges of the action's components on the episode's volume, in degrees and mm.
        """

    def act(self, observation: Observed, reward: float) -> NDArray[Any]:
        """Return the next action, as in evaluations, shape (n_action,), within [-1, 1].

        Args:
            observation: Observation of the current plane.
            reward: Reward of the current plane; before the first action, of the start.
        """


@runtime_checkable
class Learner(Agent, Protocol):
    """An agent that learns, one epoch of environment steps at a time."""

    @property
    def n_env_steps(self) -> int:
        """Environment steps taken so far, the warm-up included."""

    @property
    def env_steps_at_once(self) -> int:
        """Environment steps that budgets and epochs are rounded up to."""

    @property
    def update_note(self) -> str | None:
        """Return how gradient steps are computed, for the log; None if there is only one way."""

    def warm_up(self) -> None:
        """Take the steps that come before the first update; called once, at the very beginning."""

    def learn(self, n_env_steps: int) -> dict[str, float]:
        """Learn for one epoch of about `n_env_steps`, see `env_steps_at_once`; return its training metrics by name.

        It takes more steps to end with a whole collection, and fewer where a phase of the training ends.
        """

    def policy(self) -> Policy:
        """Return a copy of the module that `act` computes with, for batches; later learning does not change it."""

    def weights(self) -> dict[str, Any]:
        """Return the weights that `act` requires: tensors by name."""

    def load_weights(self, weights: dict[str, Any]) -> None:
        """Load what `weights` returned."""

    def state(self) -> dict[str, Any]:
        """Return the full training state, weights included: tensors, numbers, strings, lists and dicts of them.

        An agent that loads it continues bit for bit as this one does.
        """

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""


@dataclass(frozen=True, kw_only=True)
class AgentSetup:
    """Everything that an agent is made from except its own parameters.

    Args:
        make_envs: Factory of training environments, called with their number; without autoreset.
        observation_space: Observation space of one environment.
        action_names: Names of an action's components, in order, such as `("rz", "ty")`, or `("rz", "ty", "stop")`.
        total_env_steps: Budget of the training, in environment steps.
        seed: Seed of the environments, networks and replay buffer.
        compute: Device and precision of the tensors.
        n_steps: Number of steps of an episode that does not end at its first success; its last plane is the answer.
            Default: None, episodes end at the first success.
        make_validation_envs: Factory of environments on the validation volumes, for learners that fit parameters there.
            Default: None, for an agent that is not trained here, such as one that is evaluated.
    """

    make_envs: VectorEnvFactory
    observation_space: spaces.Space[Any]
    action_names: tuple[str, ...]
    total_env_steps: int
    seed: int
    compute: Compute
    n_steps: int | None = None
    make_validation_envs: VectorEnvFactory | None = None


class Algorithm(Protocol):
    """A kind of agent with its parameters, from which agents are made."""

    def agent(self, setup: AgentSetup) -> Agent:
        """Make an agent; a `Learner` has learned nothing yet."""

"""Hyperparameters of learning algorithms: their ranges, and checks against the training's budget."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

from armscan.agents.networks import NetworkChoice, check_network
from armscan.agents.protocols import AgentSetup
from armscan.errors import InvalidValueError
from armscan.utils.validation import check_bool, check_float, check_int


def number(default: float, **limits: float) -> Any:
    """Return a dataclass field for a number; `limits` are arguments of `check_float`."""
    return field(default=default, metadata={"limits": limits})


def check_numbers_of(parameters: Any) -> None:
    """Raise `InvalidValueError` unless the whole numbers, truth values and numbers of an algorithm are allowed.

    Args:
        parameters: Hyperparameters, a dataclass. Fields of other types are not checked.
    """
    for each in fields(parameters):
        name, value = f"agent.{each.name}", getattr(parameters, each.name)
        if each.type == "int":
            check_int(name, value, at_least=1)
        elif each.type == "bool":
            check_bool(name, value)
        elif each.type == "float":
            check_float(name, value, **each.metadata["limits"])


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """Hyperparameters of every learning algorithm.

    Fields of subclasses are checked by their types: whole numbers are at least 1, others within their limits.

    Raises:
        InvalidValueError: If a value is outside what is allowed.
    """

    SCHEDULABLE: ClassVar[tuple[str, ...]] = ("lr", "lr_end_factor", "batch_size")
    """Keys that a schedule may change during a training: not networks, buffer sizes or environments."""

    network: NetworkChoice
    """Network of the actor, and of the critics if the algorithm has critics."""

    lr: float = number(1e-3, above=0.0, at_most=1.0)
    """Learning rate of the networks."""

    lr_end_factor: float = number(1.0, at_least=0.0, at_most=1.0)
    """Learning rate at the end as a fraction of `lr`, approached linearly: it is set at the start of each epoch.
    Default: 1, constant.
    """

    batch_size: int = 256
    """Number of transitions, or slices, in one gradient step."""

    num_envs: int = 16
    """Number of training environments that are stepped side by side."""

    def __post_init__(self) -> None:
        check_network(self.network)
        check_numbers_of(self)

    def lr_after(self, n_env_steps: int, total_env_steps: int) -> float:
        """Return the learning rate after `n_env_steps`: linear from `lr` to `lr_end_factor` times as much."""
        return (1.0 - (1.0 - self.lr_end_factor) * min(1.0, n_env_steps / total_env_steps)) * self.lr


@dataclass(frozen=True, kw_only=True)
class PolicyParameters(Parameters):
    """Hyperparameters of every algorithm whose policy explores while it learns."""

    deterministic_eval: bool = True
    """Whether evaluations take deterministic actions, by the Gaussian's mean. False: they sample as trainings do."""


def round_up(n_env_steps: int, num_envs: int) -> int:
    """Round environment steps up to a multiple of the number of environments, which are only stepped all at once."""
    return -(-n_env_steps // num_envs) * num_envs


def buffer_capacity(buffer_size: int, num_envs: int, setup: AgentSetup) -> int:
    """Return the capacity of a buffer, in transitions: as configured, but no more than the whole training takes."""
    return min(buffer_size, setup.total_env_steps + num_envs)


def check_collection(n_asked: int, num_envs: int, setup: AgentSetup, *, learning_starts: int = 0) -> int:
    """Return the environment steps of one collection, rounded up to a multiple of `num_envs`.

    Args:
        n_asked: Requested number of environment steps.
        num_envs: Number of environments, each of which takes the same number of steps.
        setup: Training environments, observation space, action names, budget in environment steps, seed and compute.
        learning_starts: Number of environment steps before the first collection. Default: 0.

    Raises:
        InvalidValueError: If the training has fewer steps.
    """
    n_collected, n_left = round_up(n_asked, num_envs), setup.total_env_steps - learning_starts
    if n_collected > n_left:
        after = f" - {learning_starts} random ones" if learning_starts else ""
        raise InvalidValueError(
            f"agent.env_steps_per_collection is {n_asked}, {n_collected} for {num_envs} environments, but it must "
            f"be at most {n_left} = training.env_steps{after}"
        )
    return n_collected


def check_updates(utd_ratio: float, setup: AgentSetup, *, learning_starts: int = 0) -> None:
    """Raise `InvalidValueError` if a whole training would take no gradient step."""
    n_left = setup.total_env_steps - learning_starts
    if utd_ratio * n_left < 1:
        raise InvalidValueError(
            f"agent.utd_ratio is {utd_ratio:g}, but it must be at least {1 / n_left:.3g} for one gradient "
            f"step in {n_left} environment steps"
        )


def check_batch(batch_size: int, n_kept: int, what: str) -> None:
    """Raise `InvalidValueError` if a batch is larger than its source, which `what` names."""
    if batch_size > n_kept:
        raise InvalidValueError(f"agent.batch_size is {batch_size}, but it must be at most {n_kept}, {what}")

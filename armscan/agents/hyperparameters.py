"""Parameters of learning algorithms: each says what is allowed, and one place checks them all."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from armscan.agents.networks import NetworkChoice, check_network
from armscan.utils.validation import check_bool, check_float, check_int


def number(default: float, **limits: float) -> Any:
    """Return a field of a number within limits, which are named as `check_float` names them."""
    return field(default=default, metadata={"limits": limits})


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """What every learning algorithm is told.

    Fields of subclasses are checked by their types: whole numbers are at least 1, others within their limits.

    Raises:
        InvalidValueError: if a value is outside what is allowed.
    """

    network: NetworkChoice
    """Of the actor, and of the critics where there are any."""

    lr: float = number(1e-3, above=0.0, at_most=1.0)
    """Learning rate of the networks."""

    lr_end_factor: float = number(1.0, at_least=0.0, at_most=1.0)
    """Final learning rate as a fraction of `lr`, reached linearly; default: 1, constant."""

    batch_size: int = 256
    """Transitions, or slices, of one gradient step."""

    num_envs: int = 16
    """Training environments that are stepped side by side."""

    def __post_init__(self) -> None:
        check_network(self.network)
        for each in fields(self):
            name, value = f"agent.{each.name}", getattr(self, each.name)
            if each.type == "int":
                check_int(name, value, at_least=1)
            elif each.type == "bool":
                check_bool(name, value)
            elif each.type == "float":
                check_float(name, value, **each.metadata["limits"])


@dataclass(frozen=True, kw_only=True)
class PolicyParameters(Parameters):
    """What every algorithm is told whose policy explores while it learns."""

    deterministic_eval: bool = True
    """Whether the policy is evaluated by its mode; false: its actions are sampled, as they are during training."""


def lr_share(final_share: float, n_env_steps: int, total_env_steps: int) -> float:
    """Return the factor of the learning rate after `n_env_steps`: linear from 1 to `final_share`."""
    return 1.0 - (1.0 - final_share) * min(1.0, n_env_steps / total_env_steps)

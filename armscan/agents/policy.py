"""A learner's policy alone, as a plain network: a batch of observations in, actions out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import nn

from armscan.agents.compute import Compute, plain_copy
from armscan.envs.history import observation_of, parts_of
from armscan.envs.rules import Observed

# A batch of observations as tensors: one of shape (n, k), or the parts by their names, each of shape (n, ...).
ObservationTensors = torch.Tensor | dict[str, torch.Tensor]
# Reason of `Policy.differs`.
SAMPLING = "the agent samples its actions, and this is the deterministic one"


class Policy(nn.Module):
    """A copy of a learner's actor, in 32 bits on the CPU, that returns its deterministic actions.

    A deterministic action is the mean of the actor's Gaussian, squashed (SAC) or clipped (PPO) to [-1, 1].

    Args:
        actor: Actor that returns mean and standard deviation of the actions.
        bounded: Function that maps the mean to [-1, 1], as the learner does when it acts.
        compute: Device and precision of the learner.
        is_sampling: Whether the learner samples its actions in evaluations, too. Default: False.
    """

    def __init__(
        self,
        actor: nn.Module,
        bounded: Callable[[torch.Tensor], torch.Tensor],
        compute: Compute,
        *,
        is_sampling: bool = False,
    ) -> None:
        super().__init__()
        self.actor = plain_copy(actor).eval().requires_grad_(requires_grad=False)
        self._bounded = bounded
        self.differs = SAMPLING if is_sampling else None
        """Reason why the learner's own `act` may give other numbers; None if it gives the same."""
        if self.differs is None and not compute.is_float32_on_cpu:
            self.differs = f"the agent has computed with {compute.precision} on {compute.torch_device}"

    def forward(self, observations: ObservationTensors) -> torch.Tensor:
        """Return the actions for a batch of observations, shape (n, n_action), within [-1, 1]."""
        (mean, _), _ = self.actor(observations)
        return self._bounded(mean)


def clip_action(mean: torch.Tensor) -> torch.Tensor:
    """Clip the mean of actions to [-1, 1]."""
    return mean.clamp(-1.0, 1.0)


def batch_of(observations: Sequence[Observed]) -> ObservationTensors:
    """Return one or more single observations as one batch of tensors."""
    parts = [parts_of(observation) for observation in observations]
    stacked = {name: np.stack([each[name] for each in parts]) for name in parts[0]}
    tensors: Any = {name: torch.from_numpy(array) for name, array in stacked.items()}
    return cast(ObservationTensors, observation_of(tensors))

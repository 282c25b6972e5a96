"""A network's weights and Adam's state as vectors, which compiled code updates in place."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from armscan.agents.mlp_kernels import Adam, Floats, Weights


class AdamVectors:
    """Weights and optimiser state as flat vectors; torch's tensors are views of them.

    Network, optimiser and compiled code share this memory: each sees the others' changes, and torch and compiled code
    may take gradient steps in turn.

    Args:
        optimiser: Adam, with one group of parameters.

    Attributes:
        weights: Weights of all parameters, in one vector.
    """

    def __init__(self, optimiser: torch.optim.Optimizer) -> None:
        self._optimiser = optimiser
        values = flattened(self._parameters)
        gradient, exp_avg, exp_avg_sq = (np.zeros_like(values) for _ in range(3))
        steps = np.zeros(len(self._parameters), np.float32)
        self.weights = Weights(values, gradient, exp_avg, exp_avg_sq, steps)
        self._take_over_state(optimiser)
        # Loading a state replaces the views by other tensors.
        optimiser.register_load_state_dict_post_hook(self._take_over_state)

    def settings(self) -> Adam:
        """Return the optimiser's settings as they are now."""
        group: dict[str, Any] = self._optimiser.param_groups[0]
        beta1, beta2 = group["betas"]
        return Adam(group["lr"], beta1, beta2, group["eps"])

    @property
    def _parameters(self) -> list[nn.Parameter]:
        return list(self._optimiser.param_groups[0]["params"])

    def _take_over_state(self, optimiser: torch.optim.Optimizer) -> None:
        """Copy the optimiser's state, which is empty before its first step, into the vectors, and link it to them."""
        is_new = not optimiser.state
        vectors = {"step": self.weights.steps, "exp_avg": self.weights.exp_avg, "exp_avg_sq": self.weights.exp_avg_sq}
        for key, vector in vectors.items():
            if is_new:
                vector[:] = 0.0
            else:
                vector[:] = torch.cat([optimiser.state[each][key].reshape(-1) for each in self._parameters]).numpy()
            tensor = torch.from_numpy(vector)
            sizes = [each.numel() for each in self._parameters]
            parts = tensor.unbind() if key == "step" else torch.split(tensor, sizes)
            for parameter, part in zip(self._parameters, parts, strict=True):
                optimiser.state[parameter][key] = part if key == "step" else part.view_as(parameter)


def flattened(parameters: list[nn.Parameter]) -> Floats:
    """Copy parameters into one vector, make them views of it, and return it."""
    vector = parameters_to_vector(parameters).detach()
    vector_to_parameters(vector, parameters)
    values: Floats = vector.numpy()
    return values

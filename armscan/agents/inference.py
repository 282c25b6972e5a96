"""Actions of a Gaussian actor for many observations at once, each bit for bit as for that observation alone.

torch sums a batch of one in another order than a larger batch. Here a compiled loop computes networks of linear layers
and ReLU row by row, for every batch size; other networks compute one row at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic
from tianshou.utils.torch_utils import torch_train_mode
from torch import nn

from armscan.agents.compute import Compute
from armscan.agents.network_modules import is_plain
from armscan.agents.policy import batch_of
from armscan.envs.history import observation_of, parts_of, rows_of
from armscan.envs.rules import Observed
from armscan.utils.compilation import cached_njit

Rows = NDArray[np.float32]
Bounded = Callable[[torch.Tensor], torch.Tensor]


@cached_njit(nogil=True)
def linear_rows(rows: Rows, weights: Rows, bias: Rows) -> Rows:
    """Return `rows @ weights.T + bias`; each number is its bias plus the products, summed in the order of the inputs.

    Args:
        rows: Inputs, shape (n, n_inputs).
        weights: Weights, shape (n_outputs, n_inputs), as torch keeps them.
        bias: Bias, shape (n_outputs,).
    """
    by_input = np.ascontiguousarray(weights.T)
    answers = np.empty((rows.shape[0], bias.size), dtype=np.float32)
    for row in range(rows.shape[0]):
        sums = answers[row]
        for j in range(sums.size):
            sums[j] = bias[j]
        for k in range(by_input.shape[0]):
            value, of_input = rows[row, k], by_input[k]
            # Vectorised over the outputs: the order within each sum stays.
            for j in range(sums.size):
                sums[j] += value * of_input[j]
    return answers


class Inference:
    """Chooses an actor's actions in evaluations, for the episodes that `begin` has begun.

    Args:
        actor: Actor that returns mean and standard deviation of the actions, with its current weights.
        bounded: Function that maps an action to [-1, 1].
        compute: Device and precision of the actor.
        is_sampling: Whether actions are sampled; all draws of an episode come from its own seed. Default: False.
    """

    def __init__(self, actor: nn.Module, bounded: Bounded, compute: Compute, *, is_sampling: bool = False) -> None:
        self._actor, self._bounded, self._is_sampling = actor, bounded, is_sampling
        self._layers = _layers_of(actor) if compute.is_float32_on_cpu and not is_sampling else None
        self._generators: list[torch.Generator] = []

    def begin(self, seeds: Sequence[int]) -> None:
        """Begin an episode for each seed."""
        if self._is_sampling:
            self._generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def action(self, observation: Observed) -> Rows:
        """Return the action for one observation of the first episode, shape (n_action,)."""
        batch = observation_of({name: part[None] for name, part in parts_of(observation).items()})
        first: Rows = self.actions(batch, [0])[0]
        return first

    def actions(self, observations: Observed, episodes: Sequence[int] | NDArray[np.int64]) -> Rows:
        """Return an action for each observation of a batch, shape (n, n_action), within [-1, 1].

        Args:
            observations: Observations, shape (n, ...).
            episodes: Episode of each observation, its index among the seeds.
        """
        with torch.no_grad(), torch_train_mode(self._actor, enabled=False):
            if self._layers is not None:
                means = torch.from_numpy(_forward(self._layers, np.asarray(observations)))
                chosen = [self._bounded(mean) for mean in means]
            else:
                chosen = [
                    self._action_of_one(rows_of(observations, row), int(episode))
                    for row, episode in enumerate(episodes)
                ]
            actions: Rows = torch.stack(chosen).cpu().numpy()
            return actions

    def _action_of_one(self, observation: Observed, episode: int) -> torch.Tensor:
        """Return the action for one observation, shape (n_action,)."""
        (means, stds), _ = self._actor(batch_of([observation]))
        mean, std = means[0], stds[0]
        if self._is_sampling:
            mean = mean + std * torch.randn(mean.shape, generator=self._generators[episode]).to(mean.device)
        return self._bounded(mean)


def _layers_of(actor: nn.Module) -> list[nn.Module] | None:
    """Return the layers that compute an actor's mean; None if they are not all linear or ReLU."""
    if type(actor) is not ContinuousActorProbabilistic or type(actor.preprocess) is not Net or not is_plain(actor):
        return None
    if not actor._unbounded or actor.preprocess.softmax:
        return None
    layers = [*actor.preprocess.model.model, *actor.mu.model]
    has_bias = all(layer.bias is not None for layer in layers if isinstance(layer, nn.Linear))
    return layers if has_bias else None


def _forward(layers: Sequence[nn.Module], rows: Rows) -> Rows:
    for layer in layers:
        if isinstance(layer, nn.Linear):
            rows = linear_rows(rows, layer.weight.detach().numpy(), layer.bias.detach().numpy())
        else:
            np.maximum(rows, 0.0, out=rows)
    return rows

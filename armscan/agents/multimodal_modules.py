"""Modules of the network for observations with images: its body, and its critic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain, pairwise
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from tianshou.utils.net.common import ModuleWithVectorOutput
from tianshou.utils.torch_utils import torch_device
from torch import nn

from armscan.agents.convolutions import CONVOLUTIONS, count_features, images_of


class MultimodalBody(ModuleWithVectorOutput):
    """The network without its output layer.

    Args:
        space: Space of the observations.
        n_action: Number of components of the action that a critic judges; 0 for an actor.
        filters: Number of filters of each convolution.
        vector_sizes: Units of each layer for the vectors.
        head_sizes: Units of each hidden layer of the head.
    """

    def __init__(
        self,
        space: spaces.Space[Any],
        n_action: int,
        *,
        filters: Sequence[int],
        vector_sizes: Sequence[int],
        head_sizes: Sequence[int],
    ) -> None:
        super().__init__(head_sizes[-1])
        assert isinstance(space, spaces.Dict)
        images = images_of(space)
        self._vectors = [name for name in space if name not in images]
        self._scales = {name: 1.0 / float(box.high.max()) for name, box in images.items()}
        self.convolutions = nn.ModuleDict({name: _convolutions(box, filters) for name, box in images.items()})
        n_features = sum(count_features(box, filters) for box in images.values())
        n_vector = sum(int(np.prod(space[name].shape or ())) for name in self._vectors) + n_action
        self.vector = _linear_layers(n_vector, vector_sizes)
        self.head = _linear_layers(n_features + vector_sizes[-1], head_sizes)

    def forward(self, obs: Any, state: Any = None, info: Any = None, act: Any = None) -> tuple[torch.Tensor, Any]:
        """Return the features of a batch of observations, shape (n, head_sizes[-1]), and the state unchanged.

        Args:
            obs: Parts of the observations by name, each of shape (n, ...).
            state: State of recurrent networks, unused.
            info: Unused.
            act: Actions to judge, shape (n, n_action).
        """
        device = torch_device(self)
        vectors = [obs[name] for name in self._vectors] + ([] if act is None else [act])
        flat = [torch.as_tensor(vector, dtype=torch.float32, device=device).flatten(1) for vector in vectors]
        features = [self.vector(torch.cat(flat, dim=1))]
        for name, convolutions in self.convolutions.items():
            image = torch.as_tensor(obs[name], device=device)
            # Stacked frames, and their channels for the tissues, all become channels.
            frames = (
                image.reshape(image.shape[0], math.prod(image.shape[1:-2]), *image.shape[-2:]).float()
                * self._scales[name]
            )
            features.append(convolutions(frames))
        return self.head(torch.cat(features, dim=1)), state


class MultimodalCritic(nn.Module):
    """A critic of observations, or of observations with actions: a body and an output layer."""

    def __init__(self, body: MultimodalBody) -> None:
        super().__init__()
        self.body = body
        self.last = nn.Linear(body.get_output_dim(), 1)

    def forward(self, obs: Any, act: Any = None, info: Any = None) -> torch.Tensor:
        """Return the values, shape (n, 1)."""
        features, _ = self.body(obs, act=act)
        return torch.as_tensor(self.last(features))


def _convolutions(box: spaces.Box, filters: Sequence[int]) -> nn.Sequential:
    channels = pairwise([int(np.prod(box.shape[:-2])), *filters])
    layers = [(nn.Conv2d(*each, *shape), nn.ReLU()) for each, shape in zip(channels, CONVOLUTIONS, strict=True)]
    return nn.Sequential(*chain.from_iterable(layers), nn.Flatten())


def _linear_layers(n_inputs: int, sizes: Sequence[int]) -> nn.Sequential:
    layers = [(nn.Linear(n_before, n), nn.ReLU()) for n_before, n in pairwise([n_inputs, *sizes])]
    return nn.Sequential(*chain.from_iterable(layers))

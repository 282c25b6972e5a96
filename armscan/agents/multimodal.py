"""The network for observations with images: convolutions for these, linear layers for the vectors beside them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain, pairwise
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from tianshou.utils.net.common import ModuleWithVectorOutput
from tianshou.utils.net.continuous import ContinuousActorProbabilistic as Actor
from tianshou.utils.torch_utils import torch_device
from torch import nn

from armscan.agents.networks import MOST_UNITS, check_weights, gaussian_actor, init_linear, linear_weights
from armscan.errors import InvalidValueError
from armscan.utils.validation import check_ints

# Kernel and stride of each convolution.
CONVOLUTIONS = ((8, 4), (4, 2), (3, 1))


class Multimodal:
    """Convolutions for the images, linear layers for the vectors beside them, and a head for both together.

    Images: three convolutions (8 x 8 stride 4, 4 x 4 stride 2, 3 x 3 stride 1), ReLU after each, flattened; stacked
    frames are channels. Vectors (action, reward, memory, clusters, and for a critic the action it judges): two linear
    layers. Head: two more linear layers, and the output. As in the published work, with 32, 64 and 64 filters and 512
    units, after the network of Mnih et al. 2015 (doi:10.1038/nature14236).

    Args:
        filters: number of filters of each convolution.
        vector_sizes: units of each layer for the vectors.
        head_sizes: units of each layer of the head but the output.

    Raises:
        InvalidValueError: if a size is not a whole number of at least 1.
    """

    def __init__(
        self,
        filters: Sequence[int] = (32, 64, 64),
        vector_sizes: Sequence[int] = (512, 512),
        head_sizes: Sequence[int] = (512, 512),
    ) -> None:
        self.filters = list(check_ints("network.filters", filters, 3, "for the convolutions", at_least=1, at_most=4096))
        self.vector_sizes, self.head_sizes = (
            list(check_ints(f"network.{name}", sizes, None, "", at_least=1, at_most=MOST_UNITS))
            for name, sizes in (("vector_sizes", vector_sizes), ("head_sizes", head_sizes))
        )

    def chosen_for(self, observation_space: spaces.Space[Any]) -> Multimodal:
        """See `NetworkChoice.chosen_for`."""
        images = images_of(observation_space)
        if not images:
            raise InvalidValueError(
                "network is multimodal, which takes images, but the observation has none; take network=mlp, or an "
                "observation with images, such as obs=slice, and env.flat=null or false"
            )
        smallest = smallest_side_px()
        for name, box in images.items():
            if min(box.shape[-2:]) < smallest:
                raise InvalidValueError(
                    f"the observation's {name} is {' x '.join(map(str, box.shape[-2:]))} pixels, but the convolutions "
                    f"of network=multimodal need at least {smallest} x {smallest}: change obs.shape or obs.crop"
                )
        check_weights(self, self._n_weights(images.values()))
        return self

    def _n_weights(self, images: Iterable[spaces.Box]) -> int:
        """Count the weights of one network before it is made, but for those of the vectors that come in."""
        n_weights, n_features = linear_weights(self.vector_sizes), self.vector_sizes[-1]
        for box in images:
            channels = [int(np.prod(box.shape[:-2])), *self.filters]
            kernels = (kernel**2 for kernel, _ in CONVOLUTIONS)
            n_weights += sum(n_in * n * size for (n_in, n), size in zip(pairwise(channels), kernels, strict=True))
            n_features += _n_features(box, self.filters)
        return n_weights + linear_weights([n_features, *self.head_sizes])

    def actor(self, observation_space: spaces.Space[Any], n_free: int, log_std: float | None) -> Actor:
        """See `Network.actor`."""
        return gaussian_actor(MultimodalBody(self, observation_space), n_free, log_std)

    def critic(self, observation_space: spaces.Space[Any], n_action: int = 0) -> nn.Module:
        """See `Network.critic`."""
        return init_linear(MultimodalCritic(MultimodalBody(self, observation_space, n_action)))


def smallest_side_px() -> int:
    """Return the smallest side of an image that the convolutions leave a pixel of."""
    side = 1
    for kernel, stride in reversed(CONVOLUTIONS):
        side = (side - 1) * stride + kernel
    return side


def images_of(space: spaces.Space[Any]) -> dict[str, spaces.Box]:
    """Return the images among the parts of an observation, by name: those of bytes, with two axes or more."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    return {
        name: box
        for name, box in parts.items()
        if isinstance(box, spaces.Box) and box.dtype == np.uint8 and len(box.shape) >= 2
    }


class MultimodalBody(ModuleWithVectorOutput):
    """All of the network but its output.

    Args:
        network: its sizes.
        space: space of the observations.
        n_action: components of the action that a critic judges, 0 for none.
    """

    def __init__(self, network: Multimodal, space: spaces.Space[Any], n_action: int = 0) -> None:
        super().__init__(network.head_sizes[-1])
        assert isinstance(space, spaces.Dict)
        images = images_of(space)
        self._vectors = [name for name in space if name not in images]
        self._scales = {name: 1.0 / float(box.high.max()) for name, box in images.items()}
        self.convolutions = nn.ModuleDict({name: _convolutions(box, network.filters) for name, box in images.items()})
        n_features = sum(_n_features(box, network.filters) for box in images.values())
        n_vector = sum(int(np.prod(space[name].shape or ())) for name in self._vectors) + n_action
        self.vector = _linear_layers(n_vector, network.vector_sizes)
        self.head = _linear_layers(n_features + network.vector_sizes[-1], network.head_sizes)

    def forward(self, obs: Any, state: Any = None, info: Any = None, act: Any = None) -> tuple[torch.Tensor, Any]:
        """Return the features of a batch of observations, shape (n, head_sizes[-1]), and the state as it came.

        Args:
            obs: the parts by name, each shape (n, ...).
            state: state of recurrent networks, unused.
            info: unused.
            act: the actions to be judged, shape (n, n_action).
        """
        device = torch_device(self)
        vectors = [obs[name] for name in self._vectors] + ([] if act is None else [act])
        flat = [torch.as_tensor(vector, dtype=torch.float32, device=device).flatten(1) for vector in vectors]
        features = [self.vector(torch.cat(flat, dim=1))]
        for name, convolutions in self.convolutions.items():
            image = torch.as_tensor(obs[name], device=device)
            # Frames, and a channel for each tissue, side by side as channels.
            frames = image.reshape(image.shape[0], -1, *image.shape[-2:]).float() * self._scales[name]
            features.append(convolutions(frames))
        return self.head(torch.cat(features, dim=1)), state


class MultimodalCritic(nn.Module):
    """A critic of observations, or of observations with actions: a body and its output."""

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


def _n_features(box: spaces.Box, filters: Sequence[int]) -> int:
    """Return how many numbers the convolutions make of an image."""
    sides = np.array(box.shape[-2:])
    for kernel, stride in CONVOLUTIONS:
        sides = (sides - kernel) // stride + 1
    return filters[-1] * int(np.prod(sides))


def _linear_layers(n_inputs: int, sizes: Sequence[int]) -> nn.Sequential:
    layers = [(nn.Linear(n_before, n), nn.ReLU()) for n_before, n in pairwise([n_inputs, *sizes])]
    return nn.Sequential(*chain.from_iterable(layers))

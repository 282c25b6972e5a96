"""Network for observations with images: convolutions for the images, linear layers for the vectors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from armscan.agents.convolutions import CONVOLUTIONS, count_features, images_of, smallest_side_px
from armscan.agents.networks import MAX_UNITS, check_weights, linear_weights
from armscan.errors import InvalidValueError
from armscan.utils.validation import check_ints

if TYPE_CHECKING:
    from tianshou.utils.net.continuous import ContinuousActorProbabilistic as Actor
    from torch import nn

    from armscan.agents.multimodal_modules import MultimodalBody


class Multimodal:
    """Convolutions for the images, linear layers for the vectors, and a head for both together.

    Images: three convolutions (8 x 8 stride 4, 4 x 4 stride 2, 3 x 3 stride 1), ReLU after each, flattened; stacked
    frames are channels. Vectors (action, reward, memory, clusters, and for a critic the action it judges): two linear
    layers. Head: two more linear layers, and the output. The default sizes are those of the published work, after the
    network of Mnih et al. 2015 (doi:10.1038/nature14236).

    Args:
        filters: Number of filters of each convolution. Default: (32, 64, 64).
        vector_sizes: Units of each layer for the vectors. Default: (512, 512).
        head_sizes: Units of each hidden layer of the head. Default: (512, 512).

    Raises:
        InvalidValueError: If `filters` is not three whole numbers from 1 to 4096, or another list is empty or holds
            anything but whole numbers from 1 to 16,384.
    """

    def __init__(
        self,
        filters: Sequence[int] = (32, 64, 64),
        vector_sizes: Sequence[int] = (512, 512),
        head_sizes: Sequence[int] = (512, 512),
    ) -> None:
        self.filters = list(check_ints("network.filters", filters, 3, "for the convolutions", at_least=1, at_most=4096))
        self.vector_sizes, self.head_sizes = (
            list(check_ints(f"network.{name}", sizes, None, "", min_length=1, at_least=1, at_most=MAX_UNITS))
            for name, sizes in (("vector_sizes", vector_sizes), ("head_sizes", head_sizes))
        )

    def for_space(self, observation_space: spaces.Space[Any]) -> Multimodal:
        """See `NetworkChoice.for_space`."""
        images = images_of(observation_space)
        if not images:
            raise InvalidValueError(
                "network is multimodal, which takes images, but the observation has none; set network=mlp, or an "
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
        """Count the weights of one network before it is built, except those of the input vectors."""
        n_weights, n_features = linear_weights(self.vector_sizes), self.vector_sizes[-1]
        for box in images:
            channels = [int(np.prod(box.shape[:-2])), *self.filters]
            kernels = (kernel**2 for kernel, _ in CONVOLUTIONS)
            n_weights += sum(n_in * n * size for (n_in, n), size in zip(pairwise(channels), kernels, strict=True))
            n_features += count_features(box, self.filters)
        return n_weights + linear_weights([n_features, *self.head_sizes])

    def actor(self, observation_space: spaces.Space[Any], n_action: int, log_std: float | None) -> Actor:
        """See `Network.actor`."""
        from armscan.agents.network_modules import gaussian_actor

        return gaussian_actor(self.body(observation_space), n_action, log_std)

    def critic(self, observation_space: spaces.Space[Any], n_action: int = 0) -> nn.Module:
        """See `Network.critic`."""
        from armscan.agents.multimodal_modules import MultimodalCritic
        from armscan.agents.network_modules import init_linear

        return init_linear(MultimodalCritic(self.body(observation_space, n_action)))

    def body(self, observation_space: spaces.Space[Any], n_action: int = 0) -> MultimodalBody:
        """Return the network without its output layer; for a critic, `n_action` is the number of action components."""
        from armscan.agents.multimodal_modules import MultimodalBody

        sizes = {"filters": self.filters, "vector_sizes": self.vector_sizes, "head_sizes": self.head_sizes}
        return MultimodalBody(observation_space, n_action, **sizes)

"""Kinds of networks for actors and critics."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol

from gymnasium import spaces

from armscan.errors import InvalidValueError
from armscan.utils.validation import check_choice, check_ints

if TYPE_CHECKING:
    from tianshou.utils.net.continuous import ContinuousActorProbabilistic as Actor
    from torch import nn


# An actor, two critics and two target critics, with gradients and Adam's moments, take 14 times a network's weights: at
# most 4 GB.
MAX_UNITS, MAX_WEIGHTS = 16_384, 2**26
# Layers of torch.nn, by the names in the configuration.
ACTIVATIONS = {"relu": "ReLU", "tanh": "Tanh", "elu": "ELU", "gelu": "GELU"}


class NetworkChoice(Protocol):
    """Chooses a network that fits the observation space."""

    def for_space(self, observation_space: spaces.Space[Any]) -> Network:
        """Return the network for such observations; a network returns itself, if it can take them.

        Raises:
            InvalidValueError: If none can; the message says why.
        """


class Network(NetworkChoice, Protocol):
    """A kind of network for actors and critics."""

    def actor(self, observation_space: spaces.Space[Any], n_action: int, log_std: float | None) -> Actor:
        """Return a Gaussian actor.

        Args:
            observation_space: Space of one observation.
            n_action: Number of components of an action.
            log_std: Initial logarithm of the standard deviation. None: it depends on the observation.
        """

    def critic(self, observation_space: spaces.Space[Any], n_action: int = 0) -> nn.Module:
        """Return a critic of observations and actions with `n_action` components; default: of observations alone."""


class MLP:
    """Fully connected layers, for flat observations.

    Args:
        hidden_sizes: Units of each hidden layer, each from 1 to 16,384. Default: (64, 64).
        activation: Activation after each hidden layer: `relu`, `tanh`, `elu` or `gelu`. Default: `relu`.

    Raises:
        InvalidValueError: If a size is not a whole number from 1 to 16,384, or the activation is unknown.
    """

    def __init__(self, hidden_sizes: Sequence[int] = (64, 64), activation: str = "relu") -> None:
        self.hidden_sizes = list(
            check_ints("network.hidden_sizes", hidden_sizes, None, "", at_least=1, at_most=MAX_UNITS)
        )
        self.activation = ACTIVATIONS[check_choice("network.activation", activation, list(ACTIVATIONS))]

    def for_space(self, observation_space: spaces.Space[Any]) -> MLP:
        """See `NetworkChoice.for_space`."""
        if not is_vector(observation_space):
            raise InvalidValueError(
                "network is mlp, which takes one vector, but the observation has the parts "
                f"{', '.join(observation_space) if isinstance(observation_space, spaces.Dict) else observation_space}; "
                "set network=multimodal, or obs=cluster, or env.flat=true to put images and all into one vector"
            )
        check_weights(self, linear_weights([*(observation_space.shape or ()), *self.hidden_sizes]))
        return self

    def actor(self, observation_space: spaces.Space[Any], n_action: int, log_std: float | None) -> Actor:
        """See `Network.actor`."""
        from armscan.agents.network_modules import gaussian_actor, mlp_body

        return gaussian_actor(mlp_body(observation_space, self.hidden_sizes, self.activation), n_action, log_std)

    def critic(self, observation_space: spaces.Space[Any], n_action: int = 0) -> nn.Module:
        """See `Network.critic`."""
        from tianshou.utils.net.continuous import ContinuousCritic

        from armscan.agents.network_modules import init_linear, mlp_body

        body = mlp_body(observation_space, self.hidden_sizes, self.activation, n_action)
        return init_linear(ContinuousCritic(preprocess_net=body))


class NetworkByObservation:
    """Chooses one network for vectors, and another one for observations with images.

    Args:
        vector: Network for an observation that is one vector.
        images: Network for an observation of parts with images among them.
    """

    def __init__(self, vector: NetworkChoice, images: NetworkChoice) -> None:
        self.vector = check_network(vector, "network.vector")
        self.images = check_network(images, "network.images")

    def for_space(self, observation_space: spaces.Space[Any]) -> Network:
        """See `NetworkChoice.for_space`."""
        chosen = self.vector if is_vector(observation_space) else self.images
        return chosen.for_space(observation_space)


def is_vector(space: spaces.Space[Any]) -> bool:
    """Return whether observations are one vector."""
    return isinstance(space, spaces.Box) and len(space.shape) == 1


def check_network(network: NetworkChoice, name: str = "network") -> NetworkChoice:
    """Check that an object is a network, or a choice between networks, and return it.

    Args:
        network: Object to check.
        name: Its configuration key, for the message. Default: `network`.

    Raises:
        InvalidValueError: If it has no method `for_space`.
    """
    if isinstance(network, type) or not callable(getattr(network, "for_space", None)):
        by_name = f"; on the command line network={network} chooses one by its name" if isinstance(network, str) else ""
        raise InvalidValueError(
            f"{name} is {network!r}, but it must have the methods of Network, for_space first{by_name}"
        )
    return network


def linear_weights(sizes: Sequence[int]) -> int:
    """Return how many weights there are between layers of these sizes."""
    return sum(n_before * n for n_before, n in pairwise(sizes))


def check_weights(network: Network, n_weights: int) -> None:
    """Raise `InvalidValueError` if a network has too many weights."""
    if n_weights > MAX_WEIGHTS:
        raise InvalidValueError(
            f"network is {type(network).__name__.lower()} with {n_weights} weights, but there must be at most "
            f"{MAX_WEIGHTS}: take smaller layers, or smaller images (obs.shape)"
        )

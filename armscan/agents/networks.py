"""Kinds of networks for actors and critics."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Protocol

from gymnasium import spaces
from tianshou.utils.net.common import ModuleWithVectorOutput, Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic as Actor
from tianshou.utils.net.continuous import ContinuousCritic
from torch import nn

from armscan.errors import InvalidValueError
from armscan.utils.validation import check_choice, check_ints

# An actor and two critics, their lagging copies and the moments of their optimisers take 14 times a network's weights,
# which is then 4 GB.
MOST_UNITS, MOST_WEIGHTS = 16_384, 2**26
ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU, "gelu": nn.GELU}


class NetworkChoice(Protocol):
    """Chooses the network by the observation."""

    def chosen_for(self, observation_space: spaces.Space[Any]) -> Network:
        """Return the network for such observations; a network returns itself, if it can take them.

        Raises:
            InvalidValueError: if none can; the reason is said.
        """


class Network(NetworkChoice, Protocol):
    """A kind of network that can be an actor's and a critic's."""

    def actor(self, observation_space: spaces.Space[Any], n_free: int, log_std: float | None) -> Actor:
        """Return a Gaussian actor.

        Args:
            observation_space: space of one observation.
            n_free: components of an action.
            log_std: initial logarithm of the standard deviation; None: it depends on the observation.
        """

    def critic(self, observation_space: spaces.Space[Any], n_action: int = 0) -> nn.Module:
        """Return a critic of observations and actions with `n_action` components; default: of observations alone."""


class MLP:
    """Fully connected layers, for flat observations.

    Args:
        hidden_sizes: units of each hidden layer.
        activation: after each of them.

    Raises:
        InvalidValueError: if a size is not a whole number of at least 1, or the activation is unknown.
    """

    def __init__(self, hidden_sizes: Sequence[int] = (64, 64), activation: str = "relu") -> None:
        self.hidden_sizes = list(
            check_ints("network.hidden_sizes", hidden_sizes, None, "", at_least=1, at_most=MOST_UNITS)
        )
        self.activation = ACTIVATIONS[check_choice("network.activation", activation, list(ACTIVATIONS))]

    def chosen_for(self, observation_space: spaces.Space[Any]) -> MLP:
        """See `NetworkChoice.chosen_for`."""
        if not is_vector(observation_space):
            raise InvalidValueError(
                "network is mlp, which takes one vector, but the observation has the parts "
                f"{', '.join(observation_space) if isinstance(observation_space, spaces.Dict) else observation_space}; "
                "take network=multimodal, or obs=cluster, or env.flat=true to put images and all into one vector"
            )
        check_weights(self, linear_weights([*(observation_space.shape or ()), *self.hidden_sizes]))
        return self

    def actor(self, observation_space: spaces.Space[Any], n_free: int, log_std: float | None) -> Actor:
        """See `Network.actor`."""
        return gaussian_actor(self._body(observation_space), n_free, log_std)

    def critic(self, observation_space: spaces.Space[Any], n_action: int = 0) -> nn.Module:
        """See `Network.critic`."""
        body = self._body(observation_space, action_shape=n_action, concat=n_action > 0)
        return init_linear(ContinuousCritic(preprocess_net=body))

    def _body(self, space: spaces.Space[Any], **action: Any) -> Net:
        return Net(state_shape=space.shape or (), hidden_sizes=self.hidden_sizes, activation=self.activation, **action)


class NetworkByObservation:
    """The network that fits the observation: one for vectors, one for those with images.

    Args:
        vector: for one vector.
        images: for parts among which there are images.
    """

    def __init__(self, vector: NetworkChoice, images: NetworkChoice) -> None:
        self.vector = check_network(vector, "network.vector")
        self.images = check_network(images, "network.images")

    def chosen_for(self, observation_space: spaces.Space[Any]) -> Network:
        """See `NetworkChoice.chosen_for`."""
        chosen = self.vector if is_vector(observation_space) else self.images
        return chosen.chosen_for(observation_space)


def is_vector(space: spaces.Space[Any]) -> bool:
    """Whether observations are one vector."""
    return isinstance(space, spaces.Box) and len(space.shape) == 1


def check_network(network: NetworkChoice, name: str = "network") -> NetworkChoice:
    """Return the network, or the choice between some, if it is one; `name` says which it is in messages.

    Raises:
        InvalidValueError: if it cannot say which network takes an observation.
    """
    if isinstance(network, type) or not callable(getattr(network, "chosen_for", None)):
        by_name = f"; on the command line network={network} chooses one by its name" if isinstance(network, str) else ""
        raise InvalidValueError(
            f"{name} is {network!r}, but it must have the methods of Network, chosen_for first{by_name}"
        )
    return network


def linear_weights(sizes: Sequence[int]) -> int:
    """Return how many weights there are between layers of these sizes."""
    return sum(n_before * n for n_before, n in pairwise(sizes))


def check_weights(network: Network, n_weights: int) -> None:
    """Raise `InvalidValueError` where a network has too many weights."""
    if n_weights > MOST_WEIGHTS:
        raise InvalidValueError(
            f"network is {type(network).__name__.lower()} with {n_weights} weights, but there must be at most "
            f"{MOST_WEIGHTS}: take smaller layers, or smaller images (obs.shape)"
        )


def gaussian_actor(body: ModuleWithVectorOutput, n_free: int, log_std: float | None) -> Actor:
    """Return a Gaussian actor whose actions are near 0 at first; see `Network.actor`."""
    actor = Actor(preprocess_net=body, action_shape=(n_free,), unbounded=True, conditioned_sigma=log_std is None)
    if log_std is not None:
        nn.init.constant_(actor.get_parameter("sigma_param"), log_std)
    init_linear(actor)
    # Andrychowicz et al. 2020 (arXiv:2006.05990), figure 24.
    for name, weights in actor.mu.named_parameters():
        if name.endswith("weight"):
            weights.data.mul_(0.01)
    return actor


def init_linear(module: nn.Module) -> nn.Module:
    """Initialise linear layers with orthogonal weights and no bias; returns the module."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain=2**0.5)
            nn.init.zeros_(layer.bias)
    return module

"""Kinds of networks for actors and critics, as factories that Tianshou's builders take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import torch
from gymnasium import spaces
from tianshou.highlevel.env import Environments
from tianshou.highlevel.module.actor import ActorFactory, ActorFactoryContinuousGaussianNet
from tianshou.highlevel.module.critic import CriticFactory, CriticFactoryDefault
from torch import nn

from armscan.errors import InvalidValueError
from armscan.utils.validation import check_choice, check_ints

# An actor and two critics, their lagging copies and the moments of their optimisers take 14 times a network's weights,
# which is then 4 GB.
MOST_UNITS, MOST_WEIGHTS = 16_384, 2**26
ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU, "gelu": nn.GELU}


@dataclass(frozen=True)
class GaussianStd:
    """What the standard deviation of a Gaussian policy is made of.

    Args:
        conditioned: whether it depends on the observation; otherwise it is the same for all of them.
        initial_log: its logarithm at first, where it does not depend on the observation.
    """

    conditioned: bool = True
    initial_log: float = -0.5

    def initialise(self, actor: nn.Module) -> nn.Module:
        """Set the actor's standard deviation to what it is at first; returns the actor."""
        if not self.conditioned:
            nn.init.constant_(actor.get_parameter("sigma_param"), self.initial_log)
        return actor


class NetworkChoice(Protocol):
    """What says which network takes an observation."""

    def chosen_for(self, observation_space: spaces.Space[Any]) -> Network:
        """Return the network for such observations; a network returns itself, if it can take them.

        Raises:
            InvalidValueError: if none can; the reason is said.
        """


class Network(NetworkChoice, Protocol):
    """A kind of network that can be an actor's and a critic's."""

    def actor_factory(self, spread: GaussianStd) -> ActorFactory:
        """Return the factory of a Gaussian actor."""

    def critic_factory(self) -> CriticFactory:
        """Return the factory of a critic, of observations alone or of observations with actions."""


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

    def actor_factory(self, spread: GaussianStd) -> ActorFactory:
        """See `Network.actor_factory`."""
        return _MLPActorFactory(self.hidden_sizes, self.activation, spread)

    def critic_factory(self) -> CriticFactory:
        """See `Network.critic_factory`."""
        return CriticFactoryDefault(hidden_sizes=self.hidden_sizes, hidden_activation=self.activation)


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


class _MLPActorFactory(ActorFactory):
    """Tianshou's, with the standard deviation that is wanted at first."""

    def __init__(self, hidden_sizes: Sequence[int], activation: type[nn.Module], spread: GaussianStd) -> None:
        self._factory = ActorFactoryContinuousGaussianNet(
            hidden_sizes, unbounded=True, conditioned_sigma=spread.conditioned, activation=activation
        )
        self._spread = spread

    def create_module(self, envs: Environments, device: str | torch.device) -> nn.Module:
        return self._spread.initialise(self._factory.create_module(envs, device))

    def create_dist_fn(self, envs: Environments) -> Any:
        return self._factory.create_dist_fn(envs)

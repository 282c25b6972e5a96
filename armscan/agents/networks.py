"""Networks for actors and critics, as factories that Tianshou's builders take."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from gymnasium import spaces
from tianshou.highlevel.module.actor import ActorFactory, ActorFactoryDefault, ContinuousActorType
from tianshou.highlevel.module.critic import CriticFactory, CriticFactoryDefault
from torch import nn

from armscan.checks import check_choice, check_ints
from armscan.errors import InvalidValueError

ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU, "gelu": nn.GELU}


class Network(Protocol):
    """A kind of network that can be an actor's and a critic's."""

    def check(self, observation_space: spaces.Space[Any]) -> None:
        """Raises `InvalidValueError` if the network cannot take such observations."""

    def actor_factory(self) -> ActorFactory:
        """Returns the factory of a Gaussian actor whose spread depends on the observation."""

    def critic_factory(self) -> CriticFactory:
        """Returns the factory of a critic."""


class MLP:
    """Fully connected layers, for flat observations.

    Args:
        hidden_sizes: units of each hidden layer.
        activation: after each of them.

    Raises:
        InvalidValueError: if a size is not a whole number of at least 1, or the activation is unknown.
    """

    def __init__(self, hidden_sizes: Sequence[int] = (64, 64), activation: str = "relu") -> None:
        self.hidden_sizes = list(check_ints("hidden_sizes", hidden_sizes, None, "", at_least=1, at_most=65536))
        self.activation = ACTIVATIONS[check_choice("activation", activation, list(ACTIVATIONS))]

    def check(self, observation_space: spaces.Space[Any]) -> None:
        """See `Network.check`."""
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            raise InvalidValueError(
                "network is mlp, which takes one vector, but the observation has the parts "
                f"{', '.join(observation_space) if isinstance(observation_space, spaces.Dict) else observation_space}; "
                "take obs=cluster, or env.flat=true to put images and all into one vector"
            )

    def actor_factory(self) -> ActorFactory:
        """See `Network.actor_factory`."""
        return ActorFactoryDefault(
            ContinuousActorType.GAUSSIAN,
            hidden_sizes=self.hidden_sizes,
            hidden_activation=self.activation,
            continuous_unbounded=True,
            continuous_conditioned_sigma=True,
        )

    def critic_factory(self) -> CriticFactory:
        """See `Network.critic_factory`."""
        return CriticFactoryDefault(hidden_sizes=self.hidden_sizes, hidden_activation=self.activation)

"""Modules of actors and critics."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces
from tianshou.utils.net.common import MLP, ModuleWithVectorOutput, Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic as Actor
from tianshou.utils.net.continuous import ContinuousCritic
from torch import nn

PLAIN = frozenset({Actor, ContinuousCritic, Net, MLP, nn.Sequential, nn.Linear, nn.ReLU})
HOOKS = "_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks"


def mlp_body(space: spaces.Space[Any], hidden_sizes: list[int], activation: str, n_action: int = 0) -> Net:
    """Return fully connected layers for flat observations, concatenated with actions of `n_action` components.

    Args:
        space: Space of one observation.
        hidden_sizes: Units of each hidden layer.
        activation: Name of the `torch.nn` layer after each hidden layer.
        n_action: Number of components of the action that a critic judges. Default: 0, for an actor.
    """
    return Net(
        state_shape=space.shape or (),
        action_shape=n_action,
        hidden_sizes=hidden_sizes,
        activation=getattr(nn, activation),
        concat=n_action > 0,
    )


def gaussian_actor(body: ModuleWithVectorOutput, n_action: int, log_std: float | None) -> Actor:
    """Return a Gaussian actor whose actions are near 0 at first; see `Network.actor`."""
    actor = Actor(preprocess_net=body, action_shape=(n_action,), unbounded=True, conditioned_sigma=log_std is None)
    if log_std is not None:
        nn.init.constant_(actor.get_parameter("sigma_param"), log_std)
    init_linear(actor)
    # Andrychowicz et al. 2020 (arXiv:2006.05990), figure 24.
    for name, weights in actor.mu.named_parameters():
        if name.endswith("weight"):
            weights.data.mul_(0.01)
    return actor


def init_linear(module: nn.Module) -> nn.Module:
    """Initialise linear layers with orthogonal weights and zero biases; return the module."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain=2**0.5)
            nn.init.zeros_(layer.bias)
    return module


def is_plain(network: nn.Module) -> bool:
    """Return whether a network computes just what the types of its modules say: fully connected layers with ReLU.

    Subclasses and hooks, such as those of `spectral_norm`, may compute anything; layers may share weights.
    """
    parts, parameters = [*network.modules()], [*network.parameters()]
    is_hooked = any(getattr(part, name) for part in parts for name in HOOKS) or any(
        each._backward_hooks or each._post_accumulate_grad_hooks for each in parameters
    )
    is_shared = len(parameters) < len([*network.named_parameters(remove_duplicate=False)])
    return not (is_hooked or is_shared) and all(type(part) in PLAIN and "forward" not in vars(part) for part in parts)

"""Tianshou's SAC, with a compiled update where possible."""

from __future__ import annotations

import contextlib
import functools
import importlib
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from threadpoolctl import ThreadpoolController
from tianshou.algorithm.modelfree import sac
from tianshou.data import ReplayBuffer
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch import nn

from armscan.agents import sac_kernels as kernels
from armscan.agents.adam_vectors import AdamVectors, flattened
from armscan.agents.compute import Compute
from armscan.agents.mlp_kernels import Layers
from armscan.agents.network_modules import is_plain
from armscan.agents.replay import Replay
from armscan.utils.compilation import log_compilation

# Gradient steps per compiled call: enough to amortise the call, few enough to react to an interrupt quickly.
N_AT_ONCE = 16
COMPILING = "compiling SAC's update for this machine, which takes ten seconds; later runs find it in the cache"


@dataclass(kw_only=True)
class UpdateStats(sac.SACTrainingStats):
    """Means over some gradient steps."""

    gradient_steps: int
    """Number of gradient steps."""


class CompiledSAC(sac.SAC[Any]):
    """Tianshou's SAC with compiled gradient steps, each of which replaces some 9,500 Python calls.

    It draws batches and noise as Tianshou does, so both updates agree up to rounding, and each can resume from the
    other's state. Policy, buffer, collector, trainer and the format of the state are Tianshou's.

    Args:
        compute: Device and precision of the tensors.
        replay: Replay buffer to learn from.
        **arguments: Keyword arguments of Tianshou's SAC.

    Attributes:
        fallback_reason: Reason why Tianshou's own update runs; None if the update is compiled.
    """

    def __init__(self, *, compute: Compute, replay: ReplayBuffer, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.fallback_reason = fallback_reason(self, compute, replay)
        if self.fallback_reason is not None:
            return
        optimisers: list[Any] = [self.policy_optim, self.critic_optim, self.critic2_optim]
        self._adams = [AdamVectors(each._optim) for each in optimisers]
        self._targets = flattened(list(self.critic_old.parameters())), flattened(list(self.critic2_old.parameters()))
        self._entropy = AdamVectors(self.alpha._optim if isinstance(self.alpha, sac.AutoAlpha) else _fixed(self.alpha))
        self._target_entropy = float(self.alpha._target_entropy) if isinstance(self.alpha, sac.AutoAlpha) else 0.0
        self._sizes = [np.array(layer_sizes(network)) for network in (self.policy.actor, self.critic)]
        actor: Any = self.policy.actor
        self._n_action = int(actor.output_dim)
        self._layers: tuple[Layers, Layers] | None = None

    def update(self, buffer: ReplayBuffer, sample_size: int | None) -> Any:
        """Take a gradient step; see Tianshou's."""
        if self.fallback_reason is None and sample_size:
            return self.update_repeatedly(buffer, sample_size, 1)
        return super().update(buffer, sample_size)

    def update_repeatedly(self, buffer: ReplayBuffer, sample_size: int, n_updates: int) -> UpdateStats:
        """Take compiled gradient steps.

        Args:
            buffer: Replay buffer.
            sample_size: Number of transitions in each batch.
            n_updates: Number of gradient steps, 1 or more.
        """
        start_s = time.perf_counter()
        transitions = kernels.Transitions(buffer.obs, buffer.obs_next, buffer.act, buffer.rew, buffer.terminated)
        losses = np.empty((n_updates, 5))
        agent, (actor_layers, critic_layers) = self._agent(), self._layers_for(sample_size)
        compiling_is_told = log_compilation(COMPILING, lambda dispatcher: dispatcher is kernels.update)
        with _blas().limit(limits=1), _flushed_denormals(), compiling_is_told:
            for start in range(0, n_updates, N_AT_ONCE):
                part = losses[start : start + N_AT_ONCE]
                indices = buffer.sample_indices(len(part) * sample_size).reshape(len(part), sample_size)
                noise = torch.empty(len(part), 2, sample_size, self._n_action)
                for drawn in noise.flatten(0, 1):
                    drawn.normal_()
                kernels.update(transitions, indices, noise.numpy(), agent, actor_layers, critic_layers, part)
        actor_loss, critic1_loss, critic2_loss, alpha_loss, alpha = losses.mean(axis=0).tolist()
        return UpdateStats(
            actor_loss=actor_loss,
            critic1_loss=critic1_loss,
            critic2_loss=critic2_loss,
            alpha=alpha,
            alpha_loss=alpha_loss if isinstance(self.alpha, sac.AutoAlpha) else None,
            train_time=time.perf_counter() - start_s,
            gradient_steps=n_updates,
        )

    def _agent(self) -> kernels.SACState:
        actor, critic, critic2 = self._adams
        return kernels.SACState(
            actor.weights,
            (critic.weights, critic2.weights),
            self._targets,
            (actor.settings(), critic.settings(), critic2.settings()),
            kernels.Entropy(self._entropy.weights, self._entropy.settings(), self._target_entropy),
            self.gamma,
            self.tau,
        )

    def _layers_for(self, n: int) -> tuple[Layers, Layers]:
        """Return memory for the layers of actor and critic; their gradients are never needed at once."""
        if self._layers is None or self._layers[0].values.size != n * self._sizes[0].sum():
            gradient = np.empty(n * max(sizes.sum() for sizes in self._sizes), np.float32)
            actor, critic = (Layers(sizes, np.empty(n * sizes.sum(), np.float32), gradient) for sizes in self._sizes)
            self._layers = actor, critic
        return self._layers


def fallback_reason(algorithm: sac.SAC[Any], compute: Compute, replay: ReplayBuffer) -> str | None:
    """Return why Tianshou's own update must run; None if the update can be compiled."""
    optimisers: list[Any] = [*algorithm._optimizers]
    entropy = [algorithm.alpha._optim] if isinstance(algorithm.alpha, sac.AutoAlpha) else []
    networks = algorithm.policy.actor, algorithm.critic, algorithm.critic2
    sizes = [layer_sizes(network) for network in networks]
    if None in sizes or sizes[1] != sizes[2] or type(algorithm.policy) is not sac.SACPolicy:
        return "its networks are not fully connected with ReLU"
    if not all(parameter.requires_grad for network in networks for parameter in network.parameters()):
        return "a network has weights that are not trained"
    if type(replay) is not Replay:
        return f"its replay buffer is {type(replay).__name__}"
    if not compute.is_float32_on_cpu:
        return f"it computes with {compute.precision} on {compute.torch_device}"
    if compute.compile:
        return "compute.compile=true"
    if algorithm.n_step_return_horizon != 1:
        return f"its returns look {algorithm.n_step_return_horizon} steps ahead"
    is_adam = all(_is_plain_adam(each) for each in [*entropy, *(each._optim for each in optimisers)])
    if not is_adam or algorithm.lr_schedulers or any(each._max_grad_norm is not None for each in optimisers):
        return "its optimisers are not plain Adam"
    return None


def layer_sizes(network: Any) -> list[int] | None:
    """Return the sizes of a network's input and hidden layers; None if they are not fully connected with ReLU."""
    if type(network) is ContinuousActorProbabilistic and network._unbounded:
        n_heads = 2
    elif type(network) is ContinuousCritic and not network.apply_preprocess_net_to_obs_only:
        n_heads = 1
    else:
        return None
    if not is_plain(network):
        return None
    parts = [part for part in network.modules() if not any(True for _ in part.children())]
    n_hidden = (len(parts) - n_heads) // 2
    if [type(part) for part in parts] != [nn.Linear, nn.ReLU] * n_hidden + [nn.Linear] * n_heads:
        return None
    linear = [part for part in parts if isinstance(part, nn.Linear)]
    is_usual = all(each.bias is not None and each.weight.dtype == torch.float32 for each in linear)
    if type(network.preprocess) is not Net or network.preprocess.softmax or not is_usual:
        return None
    return [linear[0].in_features, *(each.out_features for each in linear[:-n_heads])]


@functools.cache
def _blas() -> ThreadpoolController:
    """Return the controller of BLAS's threads: on one, small products are fastest, and reproducible to the bit."""
    # This loads the BLAS that numba calls.
    importlib.import_module("scipy.linalg.cython_blas")
    return ThreadpoolController().select(user_api="blas")


@contextlib.contextmanager
def _flushed_denormals() -> Iterator[None]:
    """Flush denormal numbers to 0: Adam's moments for dead units become denormal, which is slow."""
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def _is_plain_adam(optimiser: Any) -> bool:
    group = optimiser.param_groups[0]
    return type(optimiser) is torch.optim.Adam and not (
        len(optimiser.param_groups) > 1 or group["weight_decay"] or group["amsgrad"] or group["maximize"]
    )


def _fixed(alpha: sac.Alpha) -> torch.optim.Adam:
    """Return an optimiser that never moves the logarithm of a fixed coefficient."""
    log_alpha = math.log(alpha.value) if alpha.value > 0.0 else -math.inf
    return torch.optim.Adam([nn.Parameter(torch.tensor(log_alpha))], lr=0.0)

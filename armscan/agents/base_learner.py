"""Base classes of learners: checked weights, and epochs whose random numbers follow from seed and epoch."""

from __future__ import annotations

import sys
import time
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from armscan.agents.policy import Policy, clip_action
from armscan.agents.protocols import AgentSetup
from armscan.envs.vector_env import ArmscanVectorEnv
from armscan.errors import CheckpointError, DivergedError


class BaseLearner(ABC):
    """Base of learners: a network, with its seed, budget, number of epochs and device.

    Args:
        setup: Setup of the agent.
    """

    _network: nn.Module

    def __init__(self, setup: AgentSetup) -> None:
        self._seed, self._total_env_steps, self._n_epochs = setup.seed, setup.total_env_steps, 0
        self._compute, self._device = setup.compute, setup.compute.torch_device

    @property
    def update_note(self) -> str | None:
        """Return the device, unless it is the CPU."""
        return None if self._device == "cpu" else f"on {self._device}"

    def weights(self) -> dict[str, Any]:
        """Return the network's weights and buffers."""
        return dict(self._network.state_dict())

    def load_weights(self, weights: dict[str, Any]) -> None:
        """Load what `weights` returned.

        Raises:
            CheckpointError: If the weights belong to another network.
        """
        load_into(self._network, weights)

    @abstractmethod
    def _lr_groups(self) -> list[dict[str, Any]]:
        """Return the parameter groups whose learning rate `_set_lr` changes."""

    def _set_lr(self, lr: float) -> None:
        for group in self._lr_groups():
            group["lr"] = lr

    def _epoch_seeds(self) -> list[np.random.SeedSequence]:
        """Seed torch for the current epoch (0: the warm-up); return three more seeds for other random numbers."""
        for_torch, *others = np.random.SeedSequence([self._seed, self._n_epochs]).spawn(4)
        torch.manual_seed(int(for_torch.generate_state(1)[0]))
        return others


class SupervisedLearner(BaseLearner):
    """Learner of one network, supervised with the labelled planes of the episodes.

    Subclasses apply the setup's `compute` to the part of the network that both learning and acting call.

    Every epoch begins with new episodes and seeds all random numbers with (`seed`, epoch), so that a learner resumes
    from its state bit for bit.

    Args:
        network: Network to train, which the optimiser updates.
        lr: Initial learning rate.
        envs: Training environments of `setup`.
        setup: Environments, spaces, budget and seed of the agent.
    """

    def __init__(self, network: nn.Module, lr: float, envs: Any, setup: AgentSetup) -> None:
        super().__init__(setup)
        self._envs, self._labelled_envs = envs, labelled_envs_of(envs)
        self._network = network.to(self._device)
        self._optimiser = torch.optim.Adam(self._network.parameters(), lr=lr)
        self._n_env_steps = 0

    @property
    def n_env_steps(self) -> int:
        """Environment steps so far: the slices learned from, the starts of episodes included."""
        return self._n_env_steps

    def policy(self) -> Policy:
        """Return a copy of the network that `act` evaluates."""
        return Policy(self._network, clip_action, self._compute)

    def warm_up(self) -> None:
        """Do nothing: the learner learns from the first plane on."""

    def learn(self, n_env_steps: int) -> dict[str, float]:
        """Learn for one epoch of at least `n_env_steps`; return its training metrics by name.

        Raises:
            DivergedError: If the weights are not finite afterwards.
        """
        self._n_epochs += 1
        for_draws, for_envs, for_others = self._epoch_seeds()
        rng = np.random.default_rng(for_draws)
        seeds = [int(word) for word in for_envs.generate_state(self._envs.num_envs)]
        n_before, start_s = self._n_env_steps, time.perf_counter()
        losses = self._learn_until(n_before + n_env_steps, seeds, rng)
        if not is_finite(self._network):
            raise diverged(self._n_env_steps)
        seconds = time.perf_counter() - start_s
        return {
            **({"update/loss": float(torch.stack(losses).mean())} if losses else {}),
            "speed/env_steps_per_s": (self._n_env_steps - n_before) / seconds,
            "speed/updates_per_s": len(losses) / seconds,
            **self._further_metrics(int(for_others.generate_state(1)[0])),
        }

    @abstractmethod
    def _learn_until(self, n_env_steps: int, seeds: list[int], rng: np.random.Generator) -> list[Tensor]:
        """Play and learn until the environments have taken this many steps in total.

        Args:
            n_env_steps: Number of environment steps.
            seeds: Seed of the first episode of each environment.
            rng: NumPy generator of all other random numbers.

        Returns:
            The loss of each gradient step.
        """

    @abstractmethod
    def _further_metrics(self, seed: int) -> dict[str, float]:
        """Return further metrics of an epoch; `seed` seeds what they draw."""

    def _lr_groups(self) -> list[dict[str, Any]]:
        return self._optimiser.param_groups

    def state(self) -> dict[str, Any]:
        """Return network, optimiser and counters."""
        return {
            "network": self.weights(),
            "optimiser": self._optimiser.state_dict(),
            "n_env_steps": self._n_env_steps,
            "n_epochs": self._n_epochs,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned.

        Raises:
            CheckpointError: If the state belongs to another agent.
        """
        self.load_weights(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._n_env_steps, self._n_epochs = state["n_env_steps"], state["n_epochs"]


def labelled_envs_of(envs: Any) -> ArmscanVectorEnv:
    """Return the environments that give a supervised learner the labelled planes."""
    assert isinstance(envs.unwrapped, ArmscanVectorEnv), "only these environments have labelled planes"
    return envs.unwrapped


def is_finite(module: nn.Module) -> bool:
    """Return whether all weights are finite."""
    return all(bool(torch.isfinite(weights).all()) for weights in module.parameters())


def diverged(n_env_steps: int, too_large: str = "agent.lr") -> DivergedError:
    """Return the error of a training whose weights are no longer finite."""
    return DivergedError(
        f"learning has diverged: after {n_env_steps} environment steps the networks' weights are no longer finite; "
        f"a smaller {too_large} may help"
    )


def load_into(module: nn.Module, weights: dict[str, Any]) -> None:
    """Load weights into a network.

    Raises:
        CheckpointError: If they belong to another network.
    """
    try:
        module.load_state_dict(weights)
    except (RuntimeError, KeyError, ValueError) as error:
        raise CheckpointError(f"the checkpoint is another agent's or network's: {error}") from error


def spare_dynamo() -> None:
    """Keep torch's optimisers from loading torch's compiler, which they do not use.

    Loading it takes one and a half seconds. Code that uses the compiler must load it first.
    """
    if "torch._dynamo" in sys.modules:
        return
    for method in vars(torch.optim.Optimizer).values():
        # `torch._disable_dynamo` looks up the compiler's version of the method here.
        if (plain := getattr(method, "__wrapped__", None)) is not None:
            vars(plain).setdefault("__dynamo_disable", plain)


def prepare_torch(seed: int) -> None:
    """Make torch compute on one thread, which is fastest for small networks, and seed the weights of new networks."""
    spare_dynamo()
    torch.set_num_threads(1)
    torch.manual_seed(seed)

"""The learner of the supervised agent: fits a network to the optimal planes of random slices."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from armscan.agents.hyperparameters import Parameters
from armscan.agents.inference import Inference
from armscan.agents.networks import Network
from armscan.agents.policy import Batch, Policy, clip_action
from armscan.agents.protocols import AgentSetup
from armscan.agents.supervised_buffer import SupervisedBuffer
from armscan.agents.tianshou_learner import diverged, is_finite, load_into, prepare_torch
from armscan.envs.actions import ActionBounds
from armscan.envs.rules import Observed
from armscan.envs.vector_env import ArmscanVectorEnv, reset_each
from armscan.volumes.plane import FloatArray

# Of normalised actions: 10 ** -2.5 is half a millimetre along an arm of 300 mm, or a third of a degree.
LOG_SPREADS = (-2.5, -0.5)


class RegressionLearner:
    """Fits a network to the optimal actions of observed planes; default: random planes.

    As in `TianshouLearner`, every epoch begins with new episodes and draws everything from `seed` and its own
    number, so that it goes on from its state bit for bit.

    Args:
        network: kind of network; the mean of its actor's actions is fitted.
        setup: environments, spaces, budget and seed of the agent.
        parameters: learning rates, batch size and number of environments.
        size: number of slices that are kept.
        utd_ratio: gradient steps for each environment step.
        own_planes_share: share of the planes to learn from that lie near those that the network would choose.
    """

    def __init__(
        self,
        network: Network,
        setup: AgentSetup,
        parameters: Parameters,
        *,
        size: int,
        utd_ratio: float,
        own_planes_share: float,
    ) -> None:
        self._parameters, self._utd_ratio, self._own_planes_share = parameters, utd_ratio, own_planes_share
        envs, n_free = setup.make_envs(parameters.num_envs), len(setup.action_names)
        assert isinstance(envs.unwrapped, ArmscanVectorEnv), "only these say where the optimal planes lie"
        self._envs, self._teacher = envs, envs.unwrapped
        self._examples = SupervisedBuffer(size, setup.observation_space, n_free)
        self._seed, self._total_env_steps = setup.seed, setup.total_env_steps
        self._compute, self._device = setup.compute, setup.compute.torch_device
        prepare_torch(setup.seed)
        self._network = network.actor(setup.observation_space, n_free, log_std=-0.5).to(self._device)
        self._optimiser = torch.optim.Adam(self._network.parameters(), lr=parameters.lr)
        self._n_env_steps = self._n_epochs = 0
        setup.compute.apply_to(self._network)
        self._inference = Inference(self._network, clip_action, setup.compute)

    @property
    def n_env_steps(self) -> int:
        """Environment steps taken so far."""
        return self._n_env_steps

    @property
    def env_steps_at_once(self) -> int:
        """One for each environment."""
        return self._envs.num_envs

    def warm_up(self) -> None:
        """Do nothing: every step is random, and the first slices can be learned from."""

    def learn(self, n_env_steps: int) -> dict[str, float]:
        """Learn for one epoch of at least `n_env_steps`; returns its training metrics by name.

        Raises:
            DivergedError: if the weights are not finite afterwards.
        """
        self._n_epochs += 1
        for_torch, for_draws, for_envs = np.random.SeedSequence([self._seed, self._n_epochs]).spawn(3)
        torch.manual_seed(int(for_torch.generate_state(1)[0]))
        rng = np.random.default_rng(for_draws)
        seeds = [int(word) for word in for_envs.generate_state(self._envs.num_envs)]
        for group in self._lr_groups():
            group["lr"] = self._parameters.lr_after(self._n_env_steps, self._total_env_steps)
        observations, _ = reset_each(self._envs, seeds)
        n_before, losses, start_s = self._n_env_steps, [], time.perf_counter()
        while self._n_env_steps - n_before < n_env_steps:
            n_updates_before = self._n_updates
            observations = self._step(observations, rng)
            losses += [self._update(rng) for _ in range(self._n_updates - n_updates_before)]
        if not is_finite(self._network):
            raise diverged(self._n_env_steps)
        seconds = time.perf_counter() - start_s
        return {
            **({"update/loss": float(torch.stack(losses).mean())} if losses else {}),
            "speed/env_steps_per_s": (self._n_env_steps - n_before) / seconds,
            "speed/updates_per_s": len(losses) / seconds,
            "replay_size": float(len(self._examples)),
        }

    def _lr_groups(self) -> list[dict[str, Any]]:
        return self._optimiser.param_groups

    @property
    def _n_updates(self) -> int:
        """Updates that are due after the steps taken so far."""
        return int(self._n_env_steps * self._utd_ratio)

    def _step(self, observations: Observed, rng: np.random.Generator) -> Observed:
        """Keep what is seen, starts of episodes included; returns what is seen from the next planes."""
        self._examples.add(observations, self._teacher.optimal_actions)
        observations, _, terminated, truncated, _ = self._envs.step(self._next_planes(observations, rng))
        self._n_env_steps += self._envs.num_envs
        if (has_ended := terminated | truncated).any():
            observations, _ = self._envs.reset(options={"reset_mask": has_ended})
        return observations

    def _next_planes(self, observations: Observed, rng: np.random.Generator) -> FloatArray:
        """Draw random planes, or such near its own choice, at distances of every order; shape (n, n_free)."""
        planes = rng.uniform(-1.0, 1.0, self._envs.action_space.shape or ())
        if not self._own_planes_share:
            return planes
        with torch.no_grad():
            chosen = self._predicted(observations).cpu().numpy()
        if not np.isfinite(chosen).all():
            raise diverged(self._n_env_steps)
        spread = 10.0 ** rng.uniform(*LOG_SPREADS, (len(planes), 1))
        near = np.clip(rng.normal(chosen, spread), -1.0, 1.0)
        return np.where(rng.random((len(planes), 1)) < self._own_planes_share, near, planes)

    def _update(self, rng: np.random.Generator) -> torch.Tensor:
        observations, optima = self._examples.draw(self._parameters.batch_size, rng)
        loss = nn.functional.mse_loss(self._predicted(observations), torch.as_tensor(optima, device=self._device))
        self._optimiser.zero_grad()
        torch.autograd.backward(loss)
        self._optimiser.step()
        return loss.detach()

    def _predicted(self, observations: Observed | Batch) -> torch.Tensor:
        """Return the predicted optimal actions of a batch, shape (n, n_free), not yet clipped."""
        (mean, _), _ = self._network(observations)
        return torch.as_tensor(mean)

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin an episode, in which nothing is drawn."""

    def act(self, observation: Observed, reward: float) -> NDArray[np.float32]:
        """Return the optimal action as predicted from this observation alone, shape (n_free,)."""
        return self._inference.action(observation)

    def begin_all(self, *, seeds: Sequence[int], bounds: Sequence[ActionBounds]) -> None:
        """Begin episodes, in which nothing is drawn."""

    def act_all(self, observations: Observed, rewards: FloatArray, episodes: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the optimal action as predicted from each observation alone, shape (n, n_free)."""
        return self._inference.actions(observations, episodes)

    def policy(self) -> Policy:
        """Return a copy of the network that `act` asks."""
        return Policy(self._network, clip_action, self._compute)

    def weights(self) -> dict[str, Any]:
        """Return the network's weights."""
        return dict(self._network.state_dict())

    def load_weights(self, weights: dict[str, Any]) -> None:
        """Take over a network's weights.

        Raises:
            CheckpointError: if they are those of another network.
        """
        load_into(self._network, weights)

    def state(self) -> dict[str, Any]:
        """Return network, optimiser, examples and counters."""
        return {
            "network": self.weights(),
            "optimiser": self._optimiser.state_dict(),
            "examples": self._examples.state(),
            "n_env_steps": self._n_env_steps,
            "n_epochs": self._n_epochs,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned.

        Raises:
            CheckpointError: if it is that of another agent.
        """
        load_into(self._network, state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._examples.load_state(state["examples"])
        self._n_env_steps, self._n_epochs = state["n_env_steps"], state["n_epochs"]

"""The learner of the supervised agent: fits a network to the labelled planes of observed slices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from armscan.agents.base_learner import SupervisedLearner, diverged, prepare_torch
from armscan.agents.hyperparameters import Parameters
from armscan.agents.inference import Inference
from armscan.agents.networks import Network
from armscan.agents.policy import ObservationTensors, clip_action
from armscan.agents.protocols import AgentSetup
from armscan.agents.supervised_buffer import SupervisedBuffer
from armscan.envs.actions import ActionBounds
from armscan.envs.rules import Observed
from armscan.envs.vector_env import reset_each
from armscan.utils.arrays import FloatArray

# Range of the decimal logarithm of normalised actions' standard deviations: 10 ** -2.5 is half a millimetre along an
# arm of 300 mm, or a third of a degree.
LOG10_STDS = (-2.5, -0.5)


class RegressionLearner(SupervisedLearner):
    """Fits a network to the optimal actions of observed planes: random ones, and a share of its own.

    Args:
        network: Kind of network; the mean of its actor's actions is fitted.
        setup: Environments, spaces, budget and seed of the agent.
        parameters: Learning rates, batch size and number of environments.
        size: Number of slices to keep.
        utd_ratio: Number of gradient steps for each environment step.
        own_planes_share: Share of the training planes that lie near the network's own choices, in [0, 1].
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
        prepare_torch(setup.seed)
        n_action = len(setup.action_names)
        actor = network.actor(setup.observation_space, n_action, log_std=-0.5)
        super().__init__(actor, parameters.lr, setup.make_envs(parameters.num_envs), setup)
        setup.compute.apply_to(actor)
        self._examples = SupervisedBuffer(size, setup.observation_space, n_action)
        self._inference = Inference(self._network, clip_action, setup.compute)

    @property
    def env_steps_at_once(self) -> int:
        """One for each environment."""
        return int(self._envs.num_envs)

    def _learn_until(self, n_env_steps: int, seeds: list[int], rng: np.random.Generator) -> list[torch.Tensor]:
        """See `SupervisedLearner._learn_until`."""
        self._set_lr(self._parameters.lr_after(self._n_env_steps, self._total_env_steps))
        observations, _ = reset_each(self._envs, seeds)
        losses: list[torch.Tensor] = []
        while self._n_env_steps < n_env_steps:
            n_updates_before = self._n_updates
            observations = self._step(observations, rng)
            losses += [self._update(rng) for _ in range(self._n_updates - n_updates_before)]
        return losses

    def _further_metrics(self, seed: int) -> dict[str, float]:
        """See `SupervisedLearner._further_metrics`."""
        return {"replay_size": float(len(self._examples))}

    @property
    def _n_updates(self) -> int:
        """Updates that are due after the steps taken so far."""
        return int(self._n_env_steps * self._utd_ratio)

    def _step(self, observations: Observed, rng: np.random.Generator) -> Observed:
        """Store the observations, starts of episodes included; return those of the next planes."""
        self._examples.add(observations, self._labelled_envs.optimal_actions)
        observations, _, terminated, truncated, _ = self._envs.step(self._next_planes(observations, rng))
        self._n_env_steps += self._envs.num_envs
        if (has_ended := terminated | truncated).any():
            observations, _ = self._envs.reset(options={"reset_mask": has_ended})
        return observations

    def _next_planes(self, observations: Observed, rng: np.random.Generator) -> FloatArray:
        """Draw planes at random, or near the network's choices with log-uniform deviations; shape (n, n_action)."""
        planes = rng.uniform(-1.0, 1.0, self._envs.action_space.shape or ())
        if not self._own_planes_share:
            return planes
        with torch.no_grad():
            chosen = self._predicted(observations).cpu().numpy()
        if not np.isfinite(chosen).all():
            raise diverged(self._n_env_steps)
        std = 10.0 ** rng.uniform(*LOG10_STDS, (len(planes), 1))
        near = np.clip(rng.normal(chosen, std), -1.0, 1.0)
        return np.where(rng.random((len(planes), 1)) < self._own_planes_share, near, planes)

    def _update(self, rng: np.random.Generator) -> torch.Tensor:
        observations, optima = self._examples.draw(self._parameters.batch_size, rng)
        loss = nn.functional.mse_loss(self._predicted(observations), torch.as_tensor(optima, device=self._device))
        self._optimiser.zero_grad()
        torch.autograd.backward(loss)
        self._optimiser.step()
        return loss.detach()

    def _predicted(self, observations: Observed | ObservationTensors) -> torch.Tensor:
        """Return the predicted optimal actions of a batch, shape (n, n_action), not yet clipped."""
        (mean, _), _ = self._network(observations)
        return torch.as_tensor(mean)

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin an episode, in which nothing is drawn."""

    def act(self, observation: Observed, reward: float) -> NDArray[np.float32]:
        """Return the optimal action predicted from this observation alone, shape (n_action,)."""
        return self._inference.action(observation)

    def begin_all(self, *, seeds: Sequence[int], bounds: Sequence[ActionBounds]) -> None:
        """Begin episodes, in which nothing is drawn."""

    def act_all(self, observations: Observed, rewards: FloatArray, episodes: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the optimal action predicted from each observation alone, shape (n, n_action)."""
        return self._inference.actions(observations, episodes)

    def state(self) -> dict[str, Any]:
        """Return network, optimiser, examples and counters."""
        return {**super().state(), "examples": self._examples.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned; see `SupervisedLearner.load_state`."""
        super().load_state(state)
        self._examples.load_state(state["examples"])

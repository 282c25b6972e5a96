"""Tianshou's collector, without a `Batch` for every step of the environments."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.modelfree.sac import SACPolicy
from tianshou.data import Collector, CollectStats
from tianshou.utils.net.continuous import SIGMA_MAX, SIGMA_MIN, ContinuousActorProbabilistic
from torch import nn
from torch.distributions import Distribution, Independent, Normal
from torch.nn.functional import linear

from armscan.agents.compiled_sac import layer_sizes
from armscan.agents.compute import Compute
from armscan.agents.replay import Replay
from armscan.agents.tianshou_envs import TianshouVectorEnv, batched
from armscan.envs.rules import Observed

Actions = NDArray[np.float32]


class StepCollector(Collector[CollectStats]):
    """Tianshou's collector, which collects steps of Gaussian policies as arrays, with the same result to the bit.

    Only episode lengths differ: they count every step, even if the buffer no longer holds all transitions.

    Tianshou makes some 7,000 Python calls for a step of all environments, most of them for a `Batch` that is made only
    to be copied into the replay buffer. `collect` and `_is_plain` decide when arrays are used.

    Args:
        policy: Policy that chooses the actions.
        envs: Training environments.
        replay: Replay buffer to add transitions to.
        compute: Device and precision of the policy.
    """

    def __init__(self, policy: Any, envs: TianshouVectorEnv, replay: Replay, compute: Compute) -> None:
        super().__init__(policy, envs, replay, exploration_noise=True)
        self._envs, self._replay = envs, replay
        actor = policy.actor
        is_bypassed = layer_sizes(actor) is not None and compute.precision == "float32"
        self._layers = [each for each in actor.modules() if isinstance(each, nn.Linear)] if is_bypassed else None

    def _is_plain(self, render: float | None, reset_arguments: dict[str, Any] | None) -> bool:
        """Return whether steps are collected as arrays: Gaussian policies without hooks, rendering or reset options."""
        hooks = self.get_on_step_hook(), self.get_on_episode_done_hook()
        is_known = type(self.policy) in (SACPolicy, ProbabilisticActorPolicy)
        is_gaussian = is_known and type(self.policy.actor) is ContinuousActorProbabilistic
        is_bare = hooks == (None, None) and not render and not reset_arguments
        return is_gaussian and is_bare and (self._pre_collect_obs_RO is not None)

    def collect(
        self,
        n_step: int | None = None,
        n_episode: int | None = None,
        random: bool = False,
        render: float | None = None,
        reset_before_collect: bool = False,
        gym_reset_kwargs: dict[str, Any] | None = None,
    ) -> CollectStats:
        """Collect steps or episodes; see Tianshou's."""
        if n_step is None or reset_before_collect or not self._is_plain(render, gym_reset_kwargs):
            return super().collect(n_step, n_episode, random, render, reset_before_collect, gym_reset_kwargs)
        self._validate_n_step_n_episode(n_episode, n_step)
        start_s = time.perf_counter()
        if self.policy.training:
            # Tianshou would restore training mode after every collection; its updates set it themselves.
            self.policy.eval()
        stats = self._collect_steps(n_step, random)
        stats.set_collect_time(time.perf_counter() - start_s)
        stats.refresh_all_sequence_stats()
        return stats

    def _collect_steps(self, n_step: int, random: bool) -> CollectStats:
        observations: Any = self._pre_collect_obs_RO
        spaces: Any = self.action_space
        ended: list[NDArray[Any]] = []
        stds: list[Actions] = []
        n_steps = 0
        while n_steps < n_step:
            if random:
                sent = np.array([space.sample() for space in spaces])
                actions = self.policy.map_action_inverse(sent)
            else:
                actions, std = self._chosen_actions(observations)
                sent = self.policy.map_action(actions)
                stds.append(std)
            observations, of_ended = self._step(observations, actions, sent)
            ended.append(of_ended)
            n_steps += self.env_num
        self._pre_collect_obs_RO = batched(observations)
        returns, lengths = np.concatenate(ended, axis=1)
        self.collect_step += n_steps
        self.collect_episode += returns.size
        return CollectStats(
            n_collected_steps=n_steps,
            n_collected_episodes=returns.size,
            returns=returns,
            lens=lengths.astype(int),
            pred_dist_std_array=np.concatenate(stds) if stds else None,
        )

    @torch.no_grad()
    def _chosen_actions(self, observations: Observed) -> tuple[Actions, Actions]:
        """Return the policy's actions and their standard deviations, each of shape (n_envs, n_action)."""
        policy: Any = self.policy
        is_sac = type(policy) is SACPolicy
        means_and_stds = self._means_and_stds(observations)
        # Raises an error for NaN, as Tianshou's distributions do.
        chosen_from: Distribution = (
            Independent(Normal(*means_and_stds), 1) if is_sac else policy.dist_fn(means_and_stds)
        )
        if policy.deterministic_eval and not policy.is_within_training_step:
            actions = chosen_from.mode
        else:
            actions = chosen_from.sample()
        return (torch.tanh(actions) if is_sac else actions).cpu().numpy(), chosen_from.stddev.cpu().numpy()

    def _means_and_stds(self, observations: Observed) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actor's means and standard deviations; bypassing its modules takes a third of the time."""
        if self._layers is None:
            policy: Any = self.policy
            means_and_stds: tuple[torch.Tensor, torch.Tensor] = policy.actor(observations)[0]
            return means_and_stds
        *hidden, mean, std = ((layer.weight, layer.bias) for layer in self._layers)
        features = torch.as_tensor(observations, dtype=torch.float32, device=mean[0].device)
        for weights in hidden:
            features = linear(features, *weights).relu()
        return linear(features, *mean), linear(features, *std).clamp(SIGMA_MIN, SIGMA_MAX).exp()

    def _step(self, observations: Observed, actions: Actions, sent: Actions) -> tuple[Observed, NDArray[Any]]:
        """Take a step in all environments and store the transitions.

        Args:
            observations: Observations of the current planes.
            actions: Actions of the policy, which are stored, shape (n_envs, n_action).
            sent: The same actions as the environments take them.

        Returns:
            The next observations, those of new episodes included; and the returns and lengths of the episodes that have
            ended, shape (2, n_ended).
        """
        observations_next, rewards, terminated, truncated = self._envs.advance(sent)
        done = terminated | truncated
        _, returns, lengths, _ = self._replay.add(
            {
                "obs": observations,
                "act": actions,
                "obs_next": observations_next,
                "rew": rewards,
                "terminated": terminated,
                "truncated": truncated,
                "done": done,
                "info": {"env_id": np.arange(self.env_num)},
            }
        )
        if done.any():
            # Observations of all environments, also of those that are not reset.
            observations_next = self._envs.begin(done)
        # Not as Tianshou counts lengths, by the transitions in the buffer, which PPO empties in the middle of episodes.
        return observations_next, np.array([returns[done], lengths[done]])

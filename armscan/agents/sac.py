"""Soft actor-critic, through Tianshou's experiment builder."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tianshou.highlevel.config import OffPolicyTrainingConfig
from tianshou.highlevel.experiment import SACExperimentBuilder
from tianshou.highlevel.params.algorithm_params import SACParams
from tianshou.highlevel.params.alpha import AutoAlphaFactoryDefault

from armscan.agents.budget_checks import buffer_capacity, check_batch, check_collection, check_updates, round_up
from armscan.agents.epoch_metrics import EpochMetricsFactory
from armscan.agents.hyperparameters import PolicyParameters, number
from armscan.agents.image_replay import replay_for
from armscan.agents.networks import GaussianStd
from armscan.agents.protocols import AgentSetup
from armscan.agents.tianshou_envs import TianshouEnvFactory
from armscan.agents.tianshou_learner import TianshouLearner, experiment_config
from armscan.errors import InvalidValueError


@dataclass(frozen=True, kw_only=True)
class SAC(PolicyParameters):
    """Soft actor-critic (Haarnoja et al. 2018, arXiv:1812.05905) with a learned entropy coefficient."""

    ent_coef_init: float = number(0.1, above=0.0, at_most=1000.0)
    """What the entropy coefficient is at first; rewards here are small, so that 1 would drown them for long."""

    ent_coef_lr: float = number(3e-4, above=0.0, at_most=1.0)
    """Learning rate of the entropy coefficient."""

    target_entropy_per_dim: float = number(-2.0, at_least=-1000.0, at_most=1000.0)
    """The policy's wanted entropy for each action component; lower where it oscillates instead of settling."""

    gamma: float = number(0.9, at_least=0.0, at_most=1.0)
    """Discount; planes are absolute, so that what comes much later matters little."""

    tau: float = number(0.005, at_least=0.0, at_most=1.0)
    """How far the target critics move towards the critics at each update."""

    buffer_size: int = 100_000
    """Transitions that the replay buffer holds; never more than the whole training takes."""

    learning_starts: int = 2_000
    """Steps with random actions before the first update, rounded up to as many for each environment."""

    env_steps_per_collection: int = 16
    """Environment steps between two rounds of updates, rounded up to as many for each environment."""

    utd_ratio: float = number(0.25, above=0.0, at_most=1000.0)
    """Gradient steps for each environment step, on average; they are what training costs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size > self.buffer_size:
            raise InvalidValueError(
                f"agent.batch_size is {self.batch_size}, but it must be at most agent.buffer_size = {self.buffer_size}"
            )

    def agent(self, setup: AgentSetup) -> TianshouLearner:
        """Make an agent that has learned nothing yet.

        Raises:
            InvalidValueError: if the training takes too few steps to learn anything, or the network cannot take the
                observations.
        """
        network = self.network.chosen_for(setup.observation_space)
        n_random = round_up(self.learning_starts, self.num_envs)
        if n_random >= setup.total_env_steps:
            raise InvalidValueError(
                f"agent.learning_starts is {self.learning_starts}, {n_random} for {self.num_envs} environments, but "
                f"it must be below training.env_steps = {setup.total_env_steps}, or nothing is learned"
            )
        n_collected = check_collection(self.env_steps_per_collection, self.num_envs, setup, learning_starts=n_random)
        check_updates(self.utd_ratio, setup, learning_starts=n_random)
        n_kept = buffer_capacity(self.buffer_size, self.num_envs, setup)
        check_batch(self.batch_size, n_kept, "which is all that training.env_steps leaves to draw from")
        builder = SACExperimentBuilder(
            TianshouEnvFactory(setup.make_envs),
            experiment_config(setup),
            OffPolicyTrainingConfig(
                num_training_envs=self.num_envs,
                num_test_envs=1,
                # Tianshou's own, which ours takes the place of.
                buffer_size=self.num_envs,
                collection_step_num_env_steps=n_collected,
                update_step_num_gradient_steps_per_sample=self.utd_ratio,
                batch_size=self.batch_size,
            ),
        )
        builder.with_logger_factory(EpochMetricsFactory())
        builder.with_sac_params(
            SACParams(
                deterministic_eval=self.deterministic_eval,
                gamma=self.gamma,
                tau=self.tau,
                actor_lr=self.lr,
                critic1_lr=self.lr,
                critic2_lr=self.lr,
                alpha=AutoAlphaFactoryDefault(
                    lr=self.ent_coef_lr,
                    target_entropy_coefficient=self.target_entropy_per_dim,
                    log_alpha=math.log(self.ent_coef_init),
                ),
            )
        )
        builder.with_actor_factory(network.actor_factory(GaussianStd(conditioned=True)))
        builder.with_common_critic_factory(network.critic_factory())
        return TianshouLearner(
            builder.build(),
            replay=replay_for(setup.observation_space, n_kept, self.num_envs),
            learning_starts=n_random,
            lr_end_factor=self.lr_end_factor,
            bounded=torch.tanh,
            setup=setup,
        )

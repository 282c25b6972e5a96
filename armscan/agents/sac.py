"""Soft actor-critic by Tianshou, with a fractional update-to-data ratio."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from armscan.agents.hyperparameters import (
    Parameters,
    PolicyParameters,
    buffer_capacity,
    check_batch,
    check_collection,
    check_updates,
    number,
    round_up,
)
from armscan.agents.networks import Network
from armscan.agents.protocols import AgentSetup
from armscan.agents.tianshou_imports import import_tianshou
from armscan.errors import InvalidValueError

if TYPE_CHECKING:
    from armscan.agents.tianshou_learner import TianshouLearner


@dataclass(frozen=True, kw_only=True)
class SAC(PolicyParameters):
    """Soft actor-critic (Haarnoja et al. 2018, arXiv:1812.05905) with a learned entropy coefficient."""

    SCHEDULABLE: ClassVar[tuple[str, ...]] = (
        *Parameters.SCHEDULABLE,
        "ent_coef_lr",
        "target_entropy_per_dim",
        "gamma",
        "tau",
        "utd_ratio",
    )
    """See `Parameters.SCHEDULABLE`."""

    ent_coef_init: float = number(0.1, above=0.0, at_most=1000.0)
    """Initial entropy coefficient; rewards here are small, so 1 would dominate them for a long time."""

    ent_coef_lr: float = number(3e-4, above=0.0, at_most=1.0)
    """Learning rate of the entropy coefficient."""

    target_entropy_per_dim: float = number(-2.0, at_least=-1000.0, at_most=1000.0)
    """Target entropy of the policy for each action component; decrease it if the policy oscillates instead of settling.
    """

    gamma: float = number(0.9, at_least=0.0, at_most=1.0)
    """Discount factor; planes are absolute, so later rewards matter little."""

    tau: float = number(0.005, at_least=0.0, at_most=1.0)
    """Rate at which the target critics follow the critics at each update."""

    buffer_size: int = 100_000
    """Number of transitions in the replay buffer; never more than the whole training takes."""

    learning_starts: int = 2_000
    """Number of environment steps with random actions before the first update, rounded up to the same number for each
    environment.
    """

    env_steps_per_collection: int = 16
    """Number of environment steps between two rounds of updates, rounded up to the same number for each environment."""

    utd_ratio: float = number(0.25, above=0.0, at_most=1000.0)
    """Mean number of gradient steps for each environment step; they dominate the training's cost."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size > self.buffer_size:
            raise InvalidValueError(
                f"agent.batch_size is {self.batch_size}, but it must be at most agent.buffer_size = {self.buffer_size}"
            )

    def agent(self, setup: AgentSetup) -> TianshouLearner:
        """Make an agent that has learned nothing yet.

        Raises:
            InvalidValueError: If the training takes too few steps to learn anything, or the network cannot take the
                observations.
        """
        network = self.network.for_space(setup.observation_space)
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
        return self._learner(setup, network, n_random=n_random, n_collected=n_collected, n_kept=n_kept)

    def _learner(
        self, setup: AgentSetup, network: Network, *, n_random: int, n_collected: int, n_kept: int
    ) -> TianshouLearner:
        import_tianshou()
        import torch
        from tianshou.algorithm.modelfree import sac
        from tianshou.algorithm.optim import AdamOptimizerFactory
        from tianshou.trainer import OffPolicyTrainerParams

        from armscan.agents.base_learner import prepare_torch
        from armscan.agents.compiled_sac import CompiledSAC
        from armscan.agents.image_replay import replay_for
        from armscan.agents.off_policy_trainer import EvenUpdatesTrainer
        from armscan.agents.tianshou_envs import TianshouVectorEnv
        from armscan.agents.tianshou_learner import TianshouLearner, training_parameters

        envs, device = TianshouVectorEnv(setup.make_envs(self.num_envs)), setup.compute.torch_device
        prepare_torch(setup.seed)
        space, n_action = setup.observation_space, len(setup.action_names)
        actor = network.actor(space, n_action, log_std=None)
        critics = [network.critic(space, n_action).to(device) for _ in range(2)]
        policy = sac.SACPolicy(
            actor=actor.to(device),
            deterministic_eval=self.deterministic_eval,
            action_space=envs.action_space[0],
            observation_space=space,
        )
        optim = AdamOptimizerFactory(lr=self.lr)
        replay = replay_for(space, n_kept, self.num_envs)
        algorithm = CompiledSAC(
            compute=setup.compute,
            replay=replay,
            policy=policy,
            policy_optim=optim,
            critic=critics[0],
            critic_optim=optim,
            critic2=critics[1],
            tau=self.tau,
            gamma=self.gamma,
            alpha=sac.AutoAlpha(
                self.target_entropy_per_dim * n_action,
                math.log(self.ent_coef_init),
                AdamOptimizerFactory(lr=self.ent_coef_lr),
            ),
        )
        params = OffPolicyTrainerParams(
            **training_parameters(policy, envs, replay, setup.compute),
            collection_step_num_env_steps=n_collected,
            update_step_num_gradient_steps_per_sample=self.utd_ratio,
            batch_size=self.batch_size,
        )
        return TianshouLearner(
            EvenUpdatesTrainer(algorithm, params, n_random),
            learning_starts=n_random,
            bounded=torch.tanh,
            parameters=self,
            setup=setup,
        )

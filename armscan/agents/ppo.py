"""Proximal policy optimisation, through Tianshou's experiment builder."""

from __future__ import annotations

from dataclasses import dataclass, fields

from tianshou.highlevel.config import OnPolicyTrainingConfig
from tianshou.highlevel.experiment import PPOExperimentBuilder
from tianshou.highlevel.params.algorithm_params import PPOParams

from armscan.agents.image_replay import replay_for
from armscan.agents.networks import Network, Spread, checked_network
from armscan.agents.protocols import AgentSetup
from armscan.agents.tianshou_envs import SideBySideFactory
from armscan.agents.tianshou_learner import TianshouLearner, experiment_config, rounded_up
from armscan.checks import check_bool, check_float, check_int


@dataclass(frozen=True, kw_only=True)
class PPO:
    """Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) with a clipped objective."""

    network: Network
    """Of the actor and of the critic."""

    lr: float = 1e-3
    """Learning rate of the actor and the critic."""

    final_lr_share: float = 1.0
    """What it has come down to at the end of the training, as a share; below 1 the policy settles."""

    gamma: float = 0.9
    """Discount; planes are absolute, so that what comes much later matters little."""

    gae_lambda: float = 0.95
    """Of generalised advantage estimation: nearer to 1 trusts the rewards, nearer to 0 the critic."""

    clip_range: float = 0.2
    """How far an action's probability may move from what it was, as a ratio, before that stops being rewarded."""

    entropy_coefficient: float = 0.003
    """Weight of the policy's entropy; higher where it settles too early."""

    value_coefficient: float = 0.5
    """Weight of the critic's loss."""

    max_grad_norm: float = 0.5
    """To which the gradient is clipped."""

    normalise_advantage: bool = True
    """Whether advantages are normalised in each batch."""

    conditioned_sigma: bool = False
    """Whether the policy's standard deviation depends on the observation."""

    initial_log_sigma: float = -0.5
    """Logarithm of the policy's standard deviation at first, where it does not depend on the observation."""

    batch_size: int = 256
    """Transitions of one gradient step."""

    num_envs: int = 16
    """Training environments that are stepped side by side."""

    env_steps_per_collection: int = 2_048
    """Environment steps between two rounds of updates, rounded up to as many for each environment."""

    passes_per_collection: int = 8
    """How often each round of updates goes through all that was collected."""

    judged_by_sampling: bool = False
    """Whether the policy is judged as it explores, by sampling, instead of by its mode."""

    def __post_init__(self) -> None:
        checked_network(self.network)
        for name in ("normalise_advantage", "conditioned_sigma", "judged_by_sampling"):
            check_bool(f"agent.{name}", getattr(self, name))
        check_float("agent.lr", self.lr, above=0.0, at_most=1.0)
        check_float("agent.max_grad_norm", self.max_grad_norm, above=0.0, at_most=1e6)
        for name in ("gamma", "gae_lambda", "final_lr_share"):
            check_float(f"agent.{name}", getattr(self, name), at_least=0.0, at_most=1.0)
        for name in ("clip_range", "entropy_coefficient", "value_coefficient"):
            check_float(f"agent.{name}", getattr(self, name), at_least=0.0, at_most=1000.0)
        check_float("agent.initial_log_sigma", self.initial_log_sigma, at_least=-20.0, at_most=2.0)
        for field in fields(self):
            if field.type == "int":
                check_int(f"agent.{field.name}", getattr(self, field.name), at_least=1)

    def agent(self, setup: AgentSetup) -> TianshouLearner:
        """Makes an agent that has learned nothing yet.

        Raises:
            InvalidValueError: if the network cannot take the observations.
        """
        network = self.network.chosen_for(setup.observation_space)
        n_collected = rounded_up(self.env_steps_per_collection, self.num_envs)
        builder = PPOExperimentBuilder(
            SideBySideFactory(setup.make_envs),
            experiment_config(setup),
            OnPolicyTrainingConfig(
                num_training_envs=self.num_envs,
                num_test_envs=1,
                # Tianshou's own, which ours takes the place of.
                buffer_size=self.num_envs,
                collection_step_num_env_steps=n_collected,
                update_step_num_repetitions=self.passes_per_collection,
                batch_size=self.batch_size,
            ),
        )
        builder.with_ppo_params(
            PPOParams(
                lr=self.lr,
                gamma=self.gamma,
                gae_lambda=self.gae_lambda,
                eps_clip=self.clip_range,
                ent_coef=self.entropy_coefficient,
                vf_coef=self.value_coefficient,
                max_grad_norm=self.max_grad_norm,
                advantage_normalization=self.normalise_advantage,
                action_bound_method="clip",
                # Actions are within [-1, 1] as they are.
                action_scaling=False,
                deterministic_eval=not self.judged_by_sampling,
            )
        )
        spread = Spread(conditioned=self.conditioned_sigma, initial_log=self.initial_log_sigma)
        builder.with_actor_factory(network.actor_factory(spread))
        builder.with_critic_factory(network.critic_factory())
        return TianshouLearner(
            builder.build(),
            replay=replay_for(setup.observation_space, n_collected, self.num_envs),
            random_env_steps=0,
            final_lr_share=self.final_lr_share,
            setup=setup,
        )

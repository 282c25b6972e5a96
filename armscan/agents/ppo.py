"""Proximal policy optimisation by Tianshou."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from armscan.agents.hyperparameters import Parameters, PolicyParameters, check_batch, check_collection, number
from armscan.agents.networks import Network
from armscan.agents.protocols import AgentSetup
from armscan.agents.tianshou_imports import import_tianshou
from armscan.errors import InvalidValueError

if TYPE_CHECKING:
    from armscan.agents.tianshou_learner import TianshouLearner


@dataclass(frozen=True, kw_only=True)
class PPO(PolicyParameters):
    """Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) with a clipped objective."""

    SCHEDULABLE: ClassVar[tuple[str, ...]] = (
        *Parameters.SCHEDULABLE,
        "gamma",
        "gae_lambda",
        "clip_range",
        "ent_coef",
        "vf_coef",
        "max_grad_norm",
        "n_epochs",
    )
    """See `Parameters.SCHEDULABLE`."""

    gamma: float = number(0.9, at_least=0.0, at_most=1.0)
    """Discount factor; planes are absolute, so later rewards matter little."""

    gae_lambda: float = number(0.95, at_least=0.0, at_most=1.0)
    """Lambda of generalised advantage estimation, in [0, 1]: nearer to 1 trusts the rewards, nearer to 0 the critic."""

    clip_range: float = number(0.2, at_least=0.0, at_most=1000.0)
    """Clipping range: largest change of an action's probability, as a ratio, that is still rewarded."""

    ent_coef: float = number(0.003, at_least=0.0, at_most=1000.0)
    """Weight of the policy's entropy; increase it if the policy converges too early."""

    vf_coef: float = number(0.5, at_least=0.0, at_most=1000.0)
    """Weight of the critic's loss."""

    max_grad_norm: float = number(0.5, above=0.0, at_most=1e6)
    """Norm to which gradients are clipped."""

    normalize_advantage: bool = True
    """Whether to normalise advantages in each batch, which must then have two transitions or more."""

    conditioned_sigma: bool = False
    """Whether the policy's standard deviation depends on the observation."""

    log_std_init: float = number(-0.5, at_least=-20.0, at_most=2.0)
    """Initial logarithm of the policy's standard deviation, if it does not depend on the observation."""

    env_steps_per_collection: int = 2_048
    """Number of environment steps between two rounds of updates, rounded up to the same number for each environment."""

    n_epochs: int = 8
    """Number of passes over the collected transitions in each round of updates."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.normalize_advantage and self.batch_size == 1:
            raise InvalidValueError(
                "agent.batch_size is 1, but it must be at least 2 with agent.normalize_advantage=true: a single "
                "advantage has no spread that it could be divided by"
            )

    def agent(self, setup: AgentSetup) -> TianshouLearner:
        """Make an agent that has learned nothing yet.

        Raises:
            InvalidValueError: If the training is shorter than a collection, a collection too small for a batch, or the
                network cannot take the observations.
        """
        network = self.network.for_space(setup.observation_space)
        n_collected = check_collection(self.env_steps_per_collection, self.num_envs, setup)
        check_batch(self.batch_size, n_collected, "the environment steps of a collection")
        return self._learner(setup, network, n_collected)

    def _learner(self, setup: AgentSetup, network: Network, n_collected: int) -> TianshouLearner:
        import_tianshou()
        from tianshou.algorithm.modelfree import ppo
        from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
        from tianshou.algorithm.optim import AdamOptimizerFactory
        from tianshou.trainer import OnPolicyTrainer, OnPolicyTrainerParams
        from torch.distributions import Independent, Normal

        from armscan.agents.base_learner import prepare_torch
        from armscan.agents.image_replay import replay_for
        from armscan.agents.policy import clip_action
        from armscan.agents.tianshou_envs import TianshouVectorEnv
        from armscan.agents.tianshou_learner import TianshouLearner, training_parameters

        envs, device = TianshouVectorEnv(setup.make_envs(self.num_envs)), setup.compute.torch_device
        prepare_torch(setup.seed)
        actor = network.actor(
            setup.observation_space,
            len(setup.action_names),
            log_std=None if self.conditioned_sigma else self.log_std_init,
        )
        critic = network.critic(setup.observation_space)
        policy = ProbabilisticActorPolicy(
            actor=actor.to(device),
            dist_fn=lambda loc_scale: Independent(Normal(*loc_scale), 1),
            deterministic_eval=self.deterministic_eval,
            action_space=envs.action_space[0],
            observation_space=setup.observation_space,
            # Actions are within [-1, 1] as they are.
            action_scaling=False,
            action_bound_method="clip",
        )
        algorithm = ppo.PPO(
            policy=policy,
            critic=critic.to(device),
            optim=AdamOptimizerFactory(lr=self.lr),
            gamma=self.gamma,
            gae_lambda=self.gae_lambda,
            eps_clip=self.clip_range,
            ent_coef=self.ent_coef,
            vf_coef=self.vf_coef,
            max_grad_norm=self.max_grad_norm,
            advantage_normalization=self.normalize_advantage,
        )
        replay = replay_for(setup.observation_space, n_collected, self.num_envs)
        params = OnPolicyTrainerParams(
            **training_parameters(policy, envs, replay, setup.compute),
            collection_step_num_env_steps=n_collected,
            update_step_num_repetitions=self.n_epochs,
            batch_size=self.batch_size,
        )
        return TianshouLearner(OnPolicyTrainer(algorithm, params), bounded=clip_action, parameters=self, setup=setup)

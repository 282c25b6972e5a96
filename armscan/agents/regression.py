"""Supervised agent that predicts the labelled plane from one observation: its configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from armscan.agents.hyperparameters import Parameters, buffer_capacity, check_batch, check_updates, number
from armscan.agents.protocols import AgentSetup
from armscan.agents.tianshou_imports import import_tianshou
from armscan.errors import InvalidValueError

if TYPE_CHECKING:
    from armscan.agents.regression_learner import RegressionLearner


@dataclass(frozen=True, kw_only=True)
class Regression(Parameters):
    """A network that predicts the labelled plane from one observation, fitted by squared error.

    Like the plane finder, it is trained with the labelled planes of the training volumes; its results show how much of
    the task needs no search. The network is an actor's, of the same size, of which only the mean of the actions is
    used. With `own_planes_share` it also learns from planes near its own choices, as in DAgger (Ross et al. 2011,
    arXiv:1011.0686).

    Raises:
        InvalidValueError: If a value is impossible.
    """

    SCHEDULABLE: ClassVar[tuple[str, ...]] = (*Parameters.SCHEDULABLE, "utd_ratio", "own_planes_share")
    """See `Parameters.SCHEDULABLE`."""

    buffer_size: int = 100_000
    """Number of latest slices to keep; never more than the whole training takes."""

    utd_ratio: float = number(0.25, above=0.0, at_most=1000.0)
    """Number of gradient steps for each environment step."""

    own_planes_share: float = number(0.0, at_least=0.0, at_most=1.0)
    """Share of the training planes that lie near the network's own choices, in [0, 1]; the others are random. Slices
    near the labelled plane, which require precision, are rare among random ones.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_envs > self.buffer_size:
            raise InvalidValueError(
                f"agent.num_envs is {self.num_envs}, but it must be at most agent.buffer_size = {self.buffer_size}"
            )

    def agent(self, setup: AgentSetup) -> RegressionLearner:
        """Make an agent that has learned nothing yet.

        Raises:
            InvalidValueError: If the training takes too few steps to learn anything, or the network cannot take the
                observations.
        """
        network = self.network.for_space(setup.observation_space)
        if self.num_envs > setup.total_env_steps:
            raise InvalidValueError(
                f"agent.num_envs is {self.num_envs}, but it must be at most training.env_steps = "
                f"{setup.total_env_steps}"
            )
        check_updates(self.utd_ratio, setup)
        size = buffer_capacity(self.buffer_size, self.num_envs, setup)
        check_batch(self.batch_size, size, "which is all that is kept of the training's slices")
        import_tianshou()
        from armscan.agents.regression_learner import RegressionLearner

        return RegressionLearner(
            network, setup, self, size=size, utd_ratio=self.utd_ratio, own_planes_share=self.own_planes_share
        )

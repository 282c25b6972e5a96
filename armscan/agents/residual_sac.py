"""A pretrained plane finder whose planes SAC corrects: its configuration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from armscan.agents.hyperparameters import number
from armscan.agents.plane_finder import PlaneFinder
from armscan.agents.protocols import AgentSetup
from armscan.agents.sac import SAC
from armscan.agents.tianshou_imports import import_tianshou
from armscan.errors import InvalidValueError
from armscan.utils.validation import check_int

if TYPE_CHECKING:
    from armscan.agents.residual_learner import ResidualLearner


@dataclass(frozen=True, kw_only=True)
class ResidualSAC(PlaneFinder):
    """A plane finder that is pretrained; SAC then corrects its planes to increase the reward, with the network frozen.

    Residual policy learning (Silver et al. 2018, arXiv:1812.06298): SAC's action is a correction of the plane that the
    pretrained network finds, and SAC observes the features that this network has computed from the looks. Until SAC
    learns, the policy is the plane finder's. The keys of the plane finder stand beside these.

    Raises:
        InvalidValueError: If a value is impossible.
    """

    sac: SAC
    """Hyperparameters of SAC; `learning_starts` counts environment steps with random corrections, and
    `deterministic_eval` must be true.
    """

    pretraining_env_steps: int
    """Number of environment steps of the pretraining; SAC gets the rest of `training.env_steps`."""

    correction_mm: float = number(2.0, above=0.0, at_most=50.0)
    """Largest correction along the normal of the plane, and across, in mm."""

    correction_deg: float = number(3.0, above=0.0, at_most=45.0)
    """Largest correction of each of the two tilts of the plane, in degrees."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.sac, SAC):
            raise InvalidValueError(f"agent.sac is {self.sac!r}, but it must be hyperparameters of SAC")
        if not self.sac.deterministic_eval:
            raise InvalidValueError(
                "agent.sac.deterministic_eval is False, but it must be true: evaluations never draw corrections"
            )
        check_int("agent.pretraining_env_steps", self.pretraining_env_steps, at_least=1)

    def agent(self, setup: AgentSetup) -> ResidualLearner:
        """Make an agent that has learned nothing yet.

        Raises:
            InvalidValueError: If the observations or actions do not fit, or the training is too short.
        """
        if self.pretraining_env_steps >= setup.total_env_steps:
            raise InvalidValueError(
                f"agent.pretraining_env_steps is {self.pretraining_env_steps}, but it must be below "
                f"training.env_steps = {setup.total_env_steps}, which leaves the rest to SAC"
            )
        try:
            self.check(replace(setup, total_env_steps=self.pretraining_env_steps))
        except InvalidValueError as error:
            raise InvalidValueError(str(error).replace("training.env_steps", "agent.pretraining_env_steps")) from error
        import_tianshou()
        from armscan.agents.residual_learner import ResidualLearner

        return ResidualLearner(
            self,
            setup,
            self.sac,
            pretraining_env_steps=self.pretraining_env_steps,
            correction_mm=self.correction_mm,
            correction_deg=self.correction_deg,
        )

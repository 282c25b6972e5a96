"""The learner of a pretrained plane finder whose planes SAC corrects."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from armscan.agents.finder_parameters import FinderParameters
from armscan.agents.look_network import FinderModule
from armscan.agents.plane_finder_learner import PlaneFinderLearner
from armscan.agents.protocols import AgentSetup
from armscan.agents.residual_envs import ResidualVectorEnv, feature_space
from armscan.agents.sac import SAC
from armscan.envs.actions import COMPONENTS
from armscan.envs.rules import Observed
from armscan.errors import DivergedError, InvalidValueError
from armscan.utils.arrays import FloatArray


class ResidualModule(nn.Module):
    """A plane finder, and the actor that corrects its planes.

    Args:
        finder: Plane finder.
        actor: Actor that maps features of the plane finder to mean and standard deviation of corrections, shape (n, 4).
        limits: Largest corrections in the frame of a look, shape (4,): sines of two tilts, mm along the normal and
            across.
    """

    limits: Tensor
    is_corrected: Tensor

    def __init__(self, finder: FinderModule, actor: nn.Module, limits: Tensor) -> None:
        super().__init__()
        self.finder, self.actor = finder, actor
        self.register_buffer("limits", limits, persistent=False)
        # 1 once SAC learns; until then, the planes are exactly the plane finder's.
        self.register_buffer("is_corrected", torch.zeros_like(limits[0]))

    def forward(self, observations: dict[str, Tensor]) -> tuple[tuple[Tensor, Tensor], None]:
        """Return the next actions, shape (n, n_action), and the expected errors of the plane finder, shape (n, 2)."""
        estimate = self.finder.found(observations)
        (means, _), _ = self.actor(estimate.features())
        corrections = self.is_corrected * torch.tanh(means) * self.limits
        return (self.finder.actions(estimate.moved(corrections)), estimate.expected), None


class ResidualLearner(PlaneFinderLearner):
    """Pretrains a plane finder, then lets SAC learn to correct its planes.

    Args:
        parameters: Parameters of the plane finder.
        setup: Environments, spaces, budget and seed of the agent.
        sac: Hyperparameters of SAC.
        pretraining_env_steps: Number of environment steps of the pretraining; SAC gets the rest of the budget.
        correction_mm: Largest correction along the normal of the plane, and across, in mm.
        correction_deg: Largest correction of each of the two tilts of the plane, in degrees.

    Raises:
        InvalidValueError: If the environment steps after the pretraining are too few for SAC.
    """

    def __init__(
        self,
        parameters: FinderParameters,
        setup: AgentSetup,
        sac: SAC,
        *,
        pretraining_env_steps: int,
        correction_mm: float,
        correction_deg: float,
    ) -> None:
        self._pretraining_env_steps = pretraining_env_steps
        super().__init__(parameters, replace(setup, total_env_steps=pretraining_env_steps))
        finder, tilt = self._module, math.sin(math.radians(correction_deg))
        limits = torch.tensor([tilt, tilt, correction_mm, correction_mm], device=self._device)
        sac_setup = replace(
            setup,
            make_envs=lambda n: ResidualVectorEnv(setup.make_envs(n), finder, limits, self._volumes),
            observation_space=feature_space(finder),
            action_names=COMPONENTS,
            total_env_steps=setup.total_env_steps - pretraining_env_steps,
        )
        try:
            self._sac = sac.agent(sac_setup)
        except InvalidValueError as error:
            budget = "training.env_steps"
            message = _of_sac(error).replace(budget, f"{budget} - agent.pretraining_env_steps")
            raise InvalidValueError(message) from error
        self._network = self._corrected = ResidualModule(finder, self._sac.actor, limits)

    @property
    def n_env_steps(self) -> int:
        """Environment steps taken so far, in pretraining and by SAC."""
        return super().n_env_steps + self._sac.n_env_steps

    @property
    def env_steps_at_once(self) -> int:
        """The larger of the plane finder's and SAC's."""
        return max(super().env_steps_at_once, self._sac.env_steps_at_once)

    @property
    def update_note(self) -> str:
        """Return how the gradient steps of SAC are computed."""
        return f"{self._sac.update_note}, after pretraining"

    def weights_note(self, n_env_steps: int) -> str | None:
        """Return a note if the weights after so many environment steps are from before SAC has learned; else None."""
        if n_env_steps > self._pretraining_env_steps:
            return None
        return (
            f"the best weights are those after {n_env_steps:,} steps, from the pretraining: the planes are the plane "
            "finder's, which SAC has not corrected"
        )

    def learn(self, n_env_steps: int) -> dict[str, float]:
        """Learn for one epoch, cut short at the end of the pretraining; see `Learner.learn`."""
        if (n_left := self._pretraining_env_steps - super().n_env_steps) > 0:
            return super().learn(min(n_env_steps, n_left))
        if not self._corrected.is_corrected:
            self._sac.warm_up()
            self._corrected.is_corrected.fill_(1.0)
            n_env_steps = max(1, n_env_steps - self._sac.n_env_steps)
        try:
            return self._sac.learn(n_env_steps)
        except DivergedError as error:
            raise DivergedError(_of_sac(error)) from error

    def act(self, observation: Observed, reward: float) -> FloatArray:
        """Return the next plane, shape (n_action,); set `expected_error` to None once SAC corrects the planes."""
        action = super().act(observation, reward)
        if self._corrected.is_corrected:
            # Those of the plane finder are calibrated on the planes before their correction.
            self.expected_error = None
        return action

    def state(self) -> dict[str, Any]:
        """Return the states of the plane finder and of SAC."""
        return {**super().state(), "sac": self._sac.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned; see `Learner.load_state`."""
        super().load_state(state)
        self._sac.load_state(state["sac"])


def _of_sac(error: Exception) -> str:
    """Return the message of an error of SAC with the keys that its hyperparameters have here."""
    return str(error).replace("agent.", "agent.sac.")

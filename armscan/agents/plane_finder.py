"""Supervised agent that looks beside the plane: its configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gymnasium import spaces

from armscan.agents.finder_parameters import FinderParameters
from armscan.agents.protocols import AgentSetup
from armscan.agents.tianshou_imports import import_tianshou
from armscan.envs.actions import COMPONENTS, STOP
from armscan.errors import InvalidValueError

if TYPE_CHECKING:
    from armscan.agents.plane_finder_learner import PlaneFinderLearner

# Parts of the observation that the agent requires, and the option that provides each.
PARTS = {"shares": "obs=slice_metric", "action": "env.flat=null or false"}


@dataclass(frozen=True, kw_only=True)
class PlaneFinder(FinderParameters):
    """Network that predicts the labelled plane from the images of the latest looks of an episode.

    One slice does not show where the plane lies to the millimetre; slices on either side of it do. So each look after
    the start is offset from the plane found so far by `offsets_mm` along its normal, and the last step takes the plane
    found. The network is trained with the labelled planes of the training volumes, on the looks that it chooses itself,
    as in DAgger (Ross et al. 2011, arXiv:1011.0686), some of them perturbed. A second head predicts the plane's error,
    in mm and degrees; it is calibrated on the validation volumes, to be right on average.

    Raises:
        InvalidValueError: If a value is impossible.
    """

    def agent(self, setup: AgentSetup) -> PlaneFinderLearner:
        """Make an agent that has learned nothing yet.

        Raises:
            InvalidValueError: If the observations or actions do not fit, or the training is too short.
        """
        self.check(setup)
        import_tianshou()
        from armscan.agents.plane_finder_learner import PlaneFinderLearner

        return PlaneFinderLearner(self, setup)

    def check(self, setup: AgentSetup) -> None:
        """Raise `InvalidValueError` if the environment or the budget of the training does not fit."""
        if setup.action_names[: len(COMPONENTS)] != COMPONENTS:
            raise InvalidValueError(
                f"agent is a plane finder, which moves all of {', '.join(COMPONENTS)}, but projection leaves "
                f"{', '.join(setup.action_names)} free: take projection=full, or experiment=plane_finder, which sets "
                "all that it needs"
            )
        check_observed(setup.observation_space, self.n_looks)
        if self.sure_mm is not None and STOP not in setup.action_names:
            raise InvalidValueError(
                f"agent.sure_mm is {self.sure_mm}, but an agent that is sure can only stop with env.ends=on_stop"
            )
        n_at_once = self.num_envs * self.n_looks
        if n_at_once > setup.total_env_steps:
            raise InvalidValueError(
                f"agent.num_envs is {self.num_envs}, so the first gradient step takes {n_at_once} environment steps "
                f"({self.n_looks} looks in each environment), but training.env_steps is {setup.total_env_steps}"
            )


def check_observed(space: spaces.Space[Any], n_looks: int) -> None:
    """Raise `InvalidValueError` unless observations are stacks of images and actions of `n_looks` looks."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    for part, choice in PARTS.items():
        if part not in parts:
            raise InvalidValueError(f"agent is a plane finder, but the observation has no part {part!r}: take {choice}")
        shape = parts[part].shape or ()
        n_stacked = shape[0] if len(shape) == (4 if part == "shares" else 2) else 1
        if n_stacked != n_looks:
            raise InvalidValueError(
                f"agent is a plane finder with {n_looks} looks (agent.offsets_mm), but {n_stacked} are stacked in the "
                f"observation's part {part!r}: take stack={n_looks} and stack_exclude=[]"
            )

"""A taught agent that looks beside the plane: what it is made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from gymnasium import spaces

from armscan.agents.hyperparameters import number
from armscan.agents.protocols import AgentSetup
from armscan.envs.actions import COMPONENTS
from armscan.errors import InvalidValueError
from armscan.utils.validation import check_float, check_int, check_ints, check_numbers

if TYPE_CHECKING:
    from armscan.agents.plane_finder_learner import PlaneFinderLearner

MOST_LOOKS, MOST_OFFSET_MM, MOST_UNITS = 20, 100.0, 4096
N_CONVOLUTIONS = 3
# Parts of the observation that it takes, and what the choice of one is called.
PARTS = {"shares": "obs=slice_metric", "action": "env.flat=null or false"}


@dataclass(frozen=True, kw_only=True)
class PlaneFinder:
    """A network that sees the latest looks of an episode as images and says where the labelled plane lies.

    One slice does not hold the last millimetre; slices on either side of the plane do. So each look but the last is
    `offsets_mm` beside the plane as it has been found so far, along its normal, and the last plane is the one found.
    The network is taught with the labelled planes of the training volumes, on the looks that it comes to by itself, as
    in DAgger (Ross et al. 2011, arXiv:1011.0686), some of them led astray. A second head says how far off the plane is
    expected to be, in mm and degrees; it is scaled to be right on average on the validation volumes.

    Raises:
        InvalidValueError: if a value is impossible.
    """

    offsets_mm: Sequence[float] = (9.0, -9.0, 0.0)
    """How far beside the plane found so far the next look is, after each look; as many as there are looks, the start
    among them. The last is 0: the answer."""

    n_seen: int = 3
    """The latest looks that the network sees; at most as many as there are."""

    filters: Sequence[int] = (12, 24, 36)
    """Of each of the three convolutions."""

    hidden_sizes: Sequence[int] = (128, 128)
    """Units of each layer after them."""

    sure_mm: float | None = None
    """It looks no further where it expects to be less than this off, and than `sure_deg`; None: it takes all looks."""

    sure_deg: float | None = None
    """See `sure_mm`; both or none are given."""

    lr: float = number(1.5e-3, above=0.0, at_most=1.0)
    """Learning rate of Adam."""

    lr_end_factor: float = number(0.02, at_least=0.0, at_most=1.0)
    """Final learning rate as a fraction of `lr`, reached along half a cosine."""

    num_envs: int = 48
    """Episodes of one gradient step, all looks of which are learned from."""

    loss_mm: float = number(1.0, above=0.0, at_most=100.0)
    """Error along the normal from which on the loss grows linearly, of all looks but the first: five times as much."""

    loss_deg: float = number(3.0, above=0.0, at_most=90.0)
    """Likewise of the angle; of the first look twice as much."""

    loss_across_mm: float = number(6.0, above=0.0, at_most=100.0)
    """Likewise of where the slice's middle lies across."""

    astray_share: float = number(0.3, at_least=0.0, at_most=1.0)
    """Share of the looks in training that are led astray, by up to some mm and degrees."""

    def __post_init__(self) -> None:
        for each in fields(self):
            if "limits" in each.metadata:
                check_float(f"agent.{each.name}", getattr(self, each.name), **each.metadata["limits"])
        for name in ("num_envs", "n_seen"):
            check_int(f"agent.{name}", getattr(self, name), at_least=1)
        for name, n_sizes in (("filters", N_CONVOLUTIONS), ("hidden_sizes", None)):
            check_ints(f"agent.{name}", getattr(self, name), n_sizes, "", at_least=1, at_most=MOST_UNITS)
        n_offsets = len(self.offsets_mm) if isinstance(self.offsets_mm, list | tuple) else 0
        offsets = check_numbers("agent.offsets_mm", self.offsets_mm, max(n_offsets, 1), "in mm, one for each look")
        if not 2 <= n_offsets <= MOST_LOOKS or offsets[-1] != 0.0 or max(map(abs, offsets)) > MOST_OFFSET_MM:
            raise InvalidValueError(
                f"agent.offsets_mm is {list(offsets)}, but it must be 2 to {MOST_LOOKS} numbers within "
                f"+-{MOST_OFFSET_MM:g} mm, the last of them 0"
            )
        if self.n_seen > n_offsets:
            raise InvalidValueError(
                f"agent.n_seen is {self.n_seen}, but it must be at most {n_offsets}, the looks of agent.offsets_mm"
            )
        if (self.sure_mm is None) != (self.sure_deg is None):
            raise InvalidValueError(
                f"agent.sure_mm is {self.sure_mm} and agent.sure_deg is {self.sure_deg}, but both or none must be given"
            )
        for name, limit in (("sure_mm", self.sure_mm), ("sure_deg", self.sure_deg)):
            if limit is not None:
                check_float(f"agent.{name}", limit, above=0.0)

    @property
    def n_looks(self) -> int:
        """Slices that an episode takes, the start among them; the plane that it answers is not looked at."""
        return len(self.offsets_mm)

    def agent(self, setup: AgentSetup) -> PlaneFinderLearner:
        """Make an agent that has learned nothing yet.

        Raises:
            InvalidValueError: if the environment does not show or allow what it needs, or the training is too short.
        """
        if setup.action_names[: len(COMPONENTS)] != COMPONENTS:
            raise InvalidValueError(
                f"agent is plane_finder, which moves all of {', '.join(COMPONENTS)}, but projection leaves "
                f"{', '.join(setup.action_names)} free: take projection=full"
            )
        check_observed(setup.observation_space, self.n_looks)
        n_at_once = self.num_envs * self.n_looks
        if n_at_once > setup.total_env_steps:
            raise InvalidValueError(
                f"agent.num_envs is {self.num_envs}, which look {n_at_once} times before the first gradient step, but "
                f"training.env_steps is {setup.total_env_steps}"
            )
        from armscan.agents.plane_finder_learner import PlaneFinderLearner

        return PlaneFinderLearner(self, setup)


def check_observed(space: spaces.Space[Any], n_looks: int) -> None:
    """Raise `InvalidValueError` where observations are not stacks of as many looks, with images and actions."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    for part, choice in PARTS.items():
        if part not in parts:
            raise InvalidValueError(f"agent is plane_finder, but the observation has no part {part!r}: take {choice}")
        shape = parts[part].shape or ()
        n_stacked = shape[0] if len(shape) == (4 if part == "shares" else 2) else 1
        if n_stacked != n_looks:
            raise InvalidValueError(
                f"agent is plane_finder with {n_looks} looks (agent.offsets_mm), but {n_stacked} are stacked in the "
                f"observation's part {part!r}: take stack={n_looks} and stack_exclude=[]"
            )

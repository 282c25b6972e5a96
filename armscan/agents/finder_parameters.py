"""Parameters of the plane finder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

from armscan.agents.hyperparameters import number
from armscan.errors import InvalidValueError
from armscan.utils.validation import check_float, check_int, check_ints, check_numbers

MOST_LOOKS, MOST_OFFSET_MM, MOST_UNITS = 20, 100.0, 4096
N_CONVOLUTIONS = 3


@dataclass(frozen=True, kw_only=True)
class FinderParameters:
    """Parameters of `PlaneFinder`: looks, network, loss and doubt.

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

    phantom_share: float | None = None
    """Share of the episodes in training that are on phantoms, where there are other volumes beside them; None: every
    volume is as frequent as any other."""

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
        if self.phantom_share is not None:
            check_float("agent.phantom_share", self.phantom_share, at_least=0.0, at_most=1.0)
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

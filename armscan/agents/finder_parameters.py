"""Parameters of the plane finder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from armscan.agents.hyperparameters import check_numbers_of, number
from armscan.errors import InvalidValueError
from armscan.utils.validation import check_float, check_ints, check_numbers

MAX_LOOKS, MAX_OFFSET_MM, MAX_LAYER_UNITS = 20, 100.0, 4096
N_CONVOLUTIONS = 3


@dataclass(frozen=True, kw_only=True)
class FinderParameters:
    """Parameters of `PlaneFinder`: looks, network, loss and expected error.

    Raises:
        InvalidValueError: If a value is impossible.
    """

    SCHEDULABLE: ClassVar[tuple[str, ...]] = (
        "lr",
        "lr_end_factor",
        "loss_mm",
        "loss_deg",
        "loss_across_mm",
        "perturbed_share",
        "phantom_share",
    )
    """See `Parameters.SCHEDULABLE`."""

    offsets_mm: Sequence[float] = (9.0, -9.0, 0.0)
    """Offset of the next plane from the plane found so far, along its normal, in mm; one after each look, the start
    included: 2 to 20 numbers from -100 to 100. The last is 0: the answer.
    """

    n_seen: int = 3
    """Number of latest looks that the network sees, from 1 to the number of looks."""

    n_averaged: int = 1
    """Number of latest looks whose estimates are averaged, weighted by the inverse squares of their expected errors;
    from 1 to the number of looks. The next look is placed beside their mean; the answer is the mean. 1: the latest
    estimate alone, with which the network is always trained.
    """

    average_tilts: bool = True
    """Whether to average tilts too. False: only distances; the tilt is the latest look's."""

    filters: Sequence[int] = (12, 24, 36)
    """Filters of each of the three convolutions, each from 1 to 4096."""

    hidden_sizes: Sequence[int] = (128, 128)
    """Units of each layer after the convolutions, each from 1 to 4096."""

    sure_mm: float | None = None
    """Largest expected error in mm, above 0, at which, with `sure_deg`, the agent stops looking. None: it takes all
    looks.
    """

    sure_deg: float | None = None
    """Expected error in degrees, above 0; see `sure_mm`. Give both or none."""

    lr: float = number(1.5e-3, above=0.0, at_most=1.0)
    """Learning rate of Adam."""

    lr_end_factor: float = number(0.02, at_least=0.0, at_most=1.0)
    """Final learning rate as a fraction of `lr`, reached by cosine decay."""

    num_envs: int = 48
    """Number of episodes in one gradient step, which learns from all their looks."""

    loss_mm: float = number(1.0, above=0.0, at_most=100.0)
    """Error along the normal, in mm, above which the smooth L1 loss is linear; five times this for the first look."""

    loss_deg: float = number(3.0, above=0.0, at_most=90.0)
    """Angle error, in degrees, above which the smooth L1 loss is linear; twice as large for the first look."""

    loss_across_mm: float = number(6.0, above=0.0, at_most=100.0)
    """Error of the slice's middle across, in mm, above which the smooth L1 loss is linear."""

    perturbed_share: float = number(0.3, at_least=0.0, at_most=1.0)
    """Share of the training looks that are perturbed at random, by some mm and degrees."""

    phantom_share: float | None = None
    """Share of the training episodes on phantoms, from 0 to 1, if there are other volumes too. None: all volumes are
    equally likely.
    """

    def __post_init__(self) -> None:
        check_numbers_of(self)
        for name, n_sizes in (("filters", N_CONVOLUTIONS), ("hidden_sizes", None)):
            sizes = getattr(self, name)
            check_ints(f"agent.{name}", sizes, n_sizes, "", min_length=1, at_least=1, at_most=MAX_LAYER_UNITS)
        n_offsets = len(self.offsets_mm) if isinstance(self.offsets_mm, list | tuple) else 0
        offsets = check_numbers("agent.offsets_mm", self.offsets_mm, max(n_offsets, 1), "in mm, one for each look")
        if not 2 <= n_offsets <= MAX_LOOKS or offsets[-1] != 0.0 or max(map(abs, offsets)) > MAX_OFFSET_MM:
            raise InvalidValueError(
                f"agent.offsets_mm is {list(offsets)}, but it must be 2 to {MAX_LOOKS} numbers within "
                f"+-{MAX_OFFSET_MM:g} mm, the last of them 0"
            )
        if self.phantom_share is not None:
            check_float("agent.phantom_share", self.phantom_share, at_least=0.0, at_most=1.0)
        for name in ("n_seen", "n_averaged"):
            if (n_latest := getattr(self, name)) > n_offsets:
                raise InvalidValueError(
                    f"agent.{name} is {n_latest}, but it must be at most {n_offsets}, the looks of agent.offsets_mm"
                )
        if (self.sure_mm is None) != (self.sure_deg is None):
            raise InvalidValueError(
                f"agent.sure_mm is {self.sure_mm} and agent.sure_deg is {self.sure_deg}, but both or none must be given"
            )
        for name, limit in (("sure_mm", self.sure_mm), ("sure_deg", self.sure_deg)):
            if limit is not None:
                check_float(f"agent.{name}", limit, above=0.0)

    def lr_after(self, n_env_steps: int, total_env_steps: int) -> float:
        """Return the learning rate after `n_env_steps`: cosine decay from `lr` to `lr_end_factor` times as much."""
        fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, n_env_steps / total_env_steps)))
        return self.lr * (self.lr_end_factor + (1.0 - self.lr_end_factor) * fall)

    @property
    def n_looks(self) -> int:
        """Number of slices that the agent sees in an episode, the start included, its answer not."""
        return len(self.offsets_mm)

"""Normalised actions: bounds of the four components, and projections to the free ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.errors import InvalidValueError, listed
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_float, check_numbers
from armscan.volumes.plane import ManipulatorAction

COMPONENTS = ("rz", "rx", "tx", "ty")
PROJECTIONS: dict[str, tuple[str, ...]] = {
    "x": ("tx",),
    "y": ("ty",),
    "xy": ("tx", "ty"),
    "zy": ("rz", "ty"),
    "full": COMPONENTS,
}
# The last component of an action if `ends` is `on_stop`: above 0, it ends the episode.
STOP = "stop"
MAX_TRANSLATION_MM = 1e6


@dataclass(frozen=True)
class ActionBounds:
    """Bounds of a plane's components, which scale the normalised vector (rz, rx, tx, ty) in [-1, 1]^4.

    Rotation is a * bound, translation (a + 1) / 2 * bound; a zero bound fixes its component at 0.

    Args:
        rotation_deg: Bounds of rz and rx, in degrees, each in [0, 180].
        translation_mm: Bounds of tx and ty, in mm, each in [0, 1e6].

    Raises:
        InvalidValueError: If a bound is out of its range.
    """

    rotation_deg: tuple[float, float]
    translation_mm: tuple[float, float]

    def __post_init__(self) -> None:
        rotation_deg = check_numbers("rotation bounds", self.rotation_deg, 2, "for rz and rx")
        translation_mm = check_numbers("translation bounds", self.translation_mm, 2, "for tx and ty")
        for name, bound in zip(("rz", "rx"), rotation_deg, strict=True):
            check_float(f"rotation bound of {name} in degrees", bound, at_least=0.0, at_most=180.0)
        for name, bound in zip(("tx", "ty"), translation_mm, strict=True):
            check_float(f"translation bound of {name} in mm", bound, at_least=0.0, at_most=MAX_TRANSLATION_MM)

    def denormalise(self, normalised: Sequence[float]) -> ManipulatorAction:
        """Return the plane of a normalised vector (rz, rx, tx, ty)."""
        rz, rx, tx, ty = normalised
        (bound_rz, bound_rx), (bound_tx, bound_ty) = self.rotation_deg, self.translation_mm
        return ManipulatorAction.of_finite(
            (rz * bound_rz, rx * bound_rx), ((tx + 1.0) / 2.0 * bound_tx, (ty + 1.0) / 2.0 * bound_ty)
        )

    def normalised(self, action: ManipulatorAction) -> FloatArray:
        """Return the normalised vector of a plane, shape (4,); 0 (a translation: -1) where the bound is zero."""
        rz, rx, tx, ty = (
            value / bound if bound > 0 else 0.0
            for value, bound in zip(
                action.rotation + action.translation, self.rotation_deg + self.translation_mm, strict=True
            )
        )
        return np.array([rz, rx, 2.0 * tx - 1.0, 2.0 * ty - 1.0])


def free_components(projection: str | Sequence[str]) -> tuple[int, ...]:
    """Return the indices into (rz, rx, tx, ty) of the components that a projection leaves free, in that order.

    Args:
        projection: Name in `PROJECTIONS`, or the components themselves.

    Raises:
        InvalidValueError: If the name or a component is unknown, none is given, or one is given twice.
    """
    if isinstance(projection, str):
        names = PROJECTIONS.get(projection, ())
    else:
        names = tuple(map(str, projection)) if isinstance(projection, Sequence) else ()
    if not names or len(set(names)) != len(names) or not set(names) <= set(COMPONENTS):
        raise InvalidValueError(
            f"projection is {projection!r}, but it must be {listed(PROJECTIONS)}, or a list of different ones of "
            f"{listed(COMPONENTS)}"
        )
    return tuple(index for index, name in enumerate(COMPONENTS) if name in names)

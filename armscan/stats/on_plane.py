"""On-plane rate: the share of episodes within limits of distance and angle from the labelled plane."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from armscan.errors import InvalidValueError
from armscan.utils.validation import check_numbers

EXPECTED = "a list of different pairs [mm, degrees], each above 0, such as [[5, 10], [2, 5]]"
PREFIX = "on_plane_"
# Key of the limits in a configuration.
ON_PLANE_KEY = "evaluation.on_plane"


class OnPlane(NamedTuple):
    """Limits within which a plane counts as the labelled one, both ends included.

    Args:
        mm: Largest distance of the slice's centre along the labelled normal, in mm, above 0.
        deg: Largest angle between the normals, in degrees, above 0.
    """

    mm: float
    deg: float

    @property
    def metric(self) -> str:
        """Name of the rate as a metric, such as `on_plane_5mm_10deg`."""
        return f"{PREFIX}{self.mm:g}mm_{self.deg:g}deg"

    @property
    def title(self) -> str:
        """Name of the rate for people, such as `on plane, 5 mm 10°`."""
        return f"on plane, {self.mm:g} mm {self.deg:g}°"

    def holds(self, distance_mm: float, distance_deg: float) -> bool:
        """Return whether a plane at this distance and angle from the labelled one is within the limits."""
        return distance_mm <= self.mm and distance_deg <= self.deg


# The leading limits, then stricter ones.
ON_PLANE = (OnPlane(5.0, 10.0), OnPlane(2.0, 5.0))


def limits_among(names: Iterable[str]) -> tuple[OnPlane, ...]:
    """Return the limits whose rates are among metrics, in their order."""
    found = (re.fullmatch(rf"{PREFIX}([\d.e+-]+)mm_([\d.e+-]+)deg", name) for name in names)
    return tuple(OnPlane(float(match[1]), float(match[2])) for match in found if match)


def check_on_plane(name: str, limits: object) -> tuple[OnPlane, ...]:
    """Return limits that were given as pairs, the leading ones first.

    Args:
        name: Name of the limits in an error, such as `evaluation.on_plane`.
        limits: Pairs of mm and degrees.

    Raises:
        InvalidValueError: If they are not a list, or empty, or an item is not a pair, not above 0, or there twice.
    """
    if not isinstance(limits, Sequence) or isinstance(limits, str) or not limits:
        raise InvalidValueError(f"{name} is {limits!r}, but it must be {EXPECTED}")
    try:
        pairs = [OnPlane(*check_numbers(name, pair, 2, "(mm, degrees) each")) for pair in limits]
    except InvalidValueError:
        pairs = []
    if not pairs or min(min(pair) for pair in pairs) <= 0.0 or len({pair.metric for pair in pairs}) < len(pairs):
        raise InvalidValueError(f"{name} is {limits!r}, but it must be {EXPECTED}")
    return tuple(pairs)


def leading_of(params: Mapping[str, str]) -> OnPlane:
    """Return the leading limits that a run's MLflow parameters name; the default limits for older runs."""
    try:
        return check_on_plane(ON_PLANE_KEY, json.loads(params[ON_PLANE_KEY]))[0]
    except (KeyError, ValueError):
        return ON_PLANE[0]

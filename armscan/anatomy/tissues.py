"""The landmark tissues and how their pixels in a slice are clustered: in pixels, as published, or in millimetres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from armscan.anatomy.clustering import count_disc_pixels, disc_half_widths
from armscan.anatomy.connected_components import IntArray
from armscan.errors import InvalidValueError
from armscan.utils.validation import check_float, check_int, check_numbers

USUAL_PIXEL_MM = (0.27, 0.55)
# From this multiple of the usual size on, clusters of pixels merge, and more planes score best. At 1.8 times, searches
# end up to 2.5 mm or 4 degrees away; at 3 to 4 times, up to 10 mm or 22 degrees (three wrists each).
COARSE = 1.5
N_TISSUES = 3
# A pixel at exactly eps is a neighbour, even if the spacing was stored as a 32-bit float.
ROUNDING = 1.0 + 1e-6
MAX_EPS_PX = 1000.0
# More pixels than a disc of the largest radius has.
MAX_SAMPLES = 10_000_000


class Neighbourhood(NamedTuple):
    """Rule for core pixels: at least `min_samples` pixels of the tissue in the disc with these half widths."""

    half_widths: IntArray
    min_samples: int


class Tissue(Protocol):
    """A landmark tissue: its label in a labelmap, and how its pixels are clustered."""

    @property
    def label(self) -> int:
        """Its value in a labelmap."""

    def neighbourhood(self, pixel_mm: tuple[float, float]) -> Neighbourhood:
        """Return the neighbourhood that makes a core pixel, for pixels of this size, (across, depth) in mm."""


@dataclass(frozen=True)
class PixelTissue:
    """A tissue clustered by DBSCAN on pixel coordinates; the size of a pixel does not matter.

    Args:
        label: Label of the tissue in a labelmap, from 0 to 255.
        eps_px: Neighbourhood radius in pixels, above 0, at most 1000.
        min_samples: Number of neighbours, the pixel itself included, that make a core pixel; from 1 to 10,000,000.

    Raises:
        InvalidValueError: If a value is out of its range.
    """

    label: int
    eps_px: float
    min_samples: int

    def __post_init__(self) -> None:
        check_int("label", self.label, at_least=0, at_most=255)
        check_float(f"eps_px of label {self.label}", self.eps_px, above=0.0, at_most=MAX_EPS_PX)
        check_int(f"min_samples of label {self.label}", self.min_samples, at_least=1, at_most=MAX_SAMPLES)

    def neighbourhood(self, pixel_mm: tuple[float, float]) -> Neighbourhood:
        """See `Tissue.neighbourhood`."""
        return Neighbourhood(disc_half_widths(self.eps_px), self.min_samples)


@dataclass(frozen=True)
class MetricTissue:
    """A tissue clustered by DBSCAN on coordinates in mm, so that one setting serves every spacing.

    Args:
        label: Label of the tissue in a labelmap, from 0 to 255.
        eps_mm: Neighbourhood radius in mm, above 0, at most 1000; at least the longer side of a pixel.
        density: Fraction of the pixels within `eps_mm`, the pixel itself included, that must be of this tissue to make
            a core pixel, in (0, 1].

    Raises:
        InvalidValueError: If a value is out of its range.
    """

    label: int
    eps_mm: float
    density: float

    def __post_init__(self) -> None:
        check_int("label", self.label, at_least=0, at_most=255)
        check_float(f"eps_mm of label {self.label}", self.eps_mm, above=0.0, at_most=1000.0)
        check_float(f"density of label {self.label}", self.density, above=0.0, at_most=1.0)

    def neighbourhood(self, pixel_mm: tuple[float, float]) -> Neighbourhood:
        """See `Tissue.neighbourhood`."""
        across_mm, depth_mm = check_numbers("pixel_mm", pixel_mm, 2, "(across, depth) in mm")
        if min(across_mm, depth_mm) <= 0:
            raise InvalidValueError(f"pixel_mm is {pixel_mm!r}, but both must be above 0")
        if self.eps_mm > MAX_EPS_PX * min(across_mm, depth_mm):
            raise InvalidValueError(
                f"eps_mm of label {self.label} is {self.eps_mm:g}, but with pixels of {across_mm:g} x {depth_mm:g} mm "
                f"it must be at most {MAX_EPS_PX * min(across_mm, depth_mm):g}, {MAX_EPS_PX:g} pixels"
            )
        if ROUNDING * self.eps_mm < max(across_mm, depth_mm):
            raise InvalidValueError(
                f"eps_mm of label {self.label} is {self.eps_mm:g}, but with pixels of {across_mm:g} x {depth_mm:g} mm "
                f"it must be at least {max(across_mm, depth_mm):g}: below, pixels have no neighbours along an axis; "
                "set clustering=pixels, or a larger eps_mm"
            )
        half_widths = disc_half_widths(ROUNDING * self.eps_mm, across_mm, depth_mm)
        return Neighbourhood(half_widths, math.ceil(self.density * count_disc_pixels(half_widths)))


class Tissues(NamedTuple):
    """The landmark tissues in their fixed order."""

    bones: Tissue
    tendons: Tissue
    artery: Tissue


# Tuned to pixels of about 0.27 mm across and 0.55 mm in depth.
PIXEL_TISSUES = Tissues(
    PixelTissue(label=1, eps_px=4.1, min_samples=46),
    PixelTissue(label=2, eps_px=3.0, min_samples=18),
    PixelTissue(label=3, eps_px=1.1, min_samples=4),
)

# Finds what the pixel mode finds at its own spacing, and the same at any other with pixels of up to about 0.55 mm. In
# pixels above 0.6 mm, pixels of the artery have no neighbour within `eps_mm`.
MAX_METRIC_PIXEL_MM = 0.6
METRIC_TISSUES = Tissues(
    MetricTissue(label=1, eps_mm=1.6, density=0.94),
    MetricTissue(label=2, eps_mm=1.2, density=0.62),
    MetricTissue(label=3, eps_mm=MAX_METRIC_PIXEL_MM, density=0.8),
)
CLUSTERINGS: dict[str, Tissues] = {"pixels": PIXEL_TISSUES, "metric": METRIC_TISSUES}


def is_coarse(pixel_mm: tuple[float, float]) -> bool:
    """Return whether pixels (across, depth), in mm, are too large for `PIXEL_TISSUES`."""
    return any(mm > COARSE * usual for mm, usual in zip(pixel_mm, USUAL_PIXEL_MM, strict=True))


def check_tissues(clustering: str | Tissues) -> Tissues:
    """Return clustering rules given as `Tissues` or by name."""
    if isinstance(clustering, str) and clustering in CLUSTERINGS:
        return CLUSTERINGS[clustering]
    if not isinstance(clustering, Tissues):
        raise InvalidValueError(
            f"clustering is {clustering!r}, but it must be {' or '.join(CLUSTERINGS)}, or an armscan.anatomy.Tissues"
        )
    for name, tissue in clustering._asdict().items():
        has_parts = hasattr(tissue, "label") and callable(getattr(tissue, "neighbourhood", None))
        if isinstance(tissue, type) or not has_parts:
            raise InvalidValueError(f"{name} is {tissue!r}, but it must be a PixelTissue, a MetricTissue or the like")
    return clustering

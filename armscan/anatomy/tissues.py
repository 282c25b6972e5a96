"""The landmark tissues and how their pixels in a slice are clustered."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.checks import check_float, check_int


@dataclass(frozen=True)
class Tissue:
    """One landmark tissue.

    Args:
        name: as in `TissueClusters`.
        label: its value in a labelmap.
        eps_px: DBSCAN's neighbourhood radius in pixels.
        min_samples: neighbours, the point itself included, that make a core point.
        usual_area_px: clustered pixels that the tissue usually shows, at 0.27 x 0.55 mm a pixel.
    """

    name: str
    label: int
    eps_px: float
    min_samples: int
    usual_area_px: float

    def __post_init__(self) -> None:
        check_int(f"{self.name}: label", self.label, at_least=0, at_most=255)
        check_float(f"{self.name}: eps_px", self.eps_px, above=0.0, at_most=1000.0)
        check_int(f"{self.name}: min_samples", self.min_samples, at_least=1)


# Tuned to pixels of about 0.27 mm across and 0.55 mm in depth.
BONES = Tissue("bones", label=1, eps_px=4.1, min_samples=46, usual_area_px=3000.0)
TENDONS = Tissue("tendons", label=2, eps_px=3.0, min_samples=18, usual_area_px=1000.0)
ARTERY = Tissue("artery", label=3, eps_px=1.1, min_samples=4, usual_area_px=100.0)
TISSUES = (BONES, TENDONS, ARTERY)
USUAL_PIXEL_MM = (0.27, 0.55)

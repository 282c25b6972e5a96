"""Clusters of each landmark tissue in a slice, and their summary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from armscan.anatomy.clustering import cluster_label
from armscan.anatomy.tissues import PIXEL_TISSUES, USUAL_PIXEL_MM, Tissues, check_tissues
from armscan.errors import InvalidValueError
from armscan.volumes import LABEL_NAMES, LANDMARK_LABELS
from armscan.volumes.labelmap import TISSUE_LABELS

Landmarks = NDArray[np.float64]
"""Summary of a slice, shape (3, 4): a row for bones, tendons and artery, each with the number of clusters, the number
of pixels in them, and the mean of the clusters' centres, (across, depth) in pixels, 0 if there is no cluster."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """The clusters of one tissue in one slice.

    Args:
        image: Cluster number of each pixel, from 1; 0 for noise and background. Has the shape of the slice.
        centres: Mean pixel coordinates of each cluster, (across, depth), shape (n, 2).
        sizes: Number of pixels of each cluster, shape (n,).
    """

    image: NDArray[np.int32]
    centres: NDArray[np.float64]
    sizes: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.sizes)

    @property
    def n_pixels(self) -> int:
        """Number of pixels that belong to a cluster."""
        return int(self.sizes.sum())

    @property
    def mean_centre(self) -> NDArray[np.float64]:
        """Mean of the clusters' centres, (across, depth) in pixels; zeros if there is no cluster."""
        return self.centres.mean(axis=0) if len(self) else np.zeros(2)


@dataclass(frozen=True, eq=False)
class TissueClusters:
    """The clusters of every landmark tissue in one slice."""

    bones: Clusters
    tendons: Clusters
    artery: Clusters

    @classmethod
    def from_slice(
        cls,
        slice_xz: NDArray[Any],
        tissues: str | Tissues = PIXEL_TISSUES,
        pixel_mm: tuple[float, float] = USUAL_PIXEL_MM,
    ) -> Self:
        """Cluster a slice of labels, indexed [across, depth].

        Args:
            slice_xz: Integer labels of the slice, indexed [across, depth].
            tissues: Clustering rules: `pixels`, `metric`, or an `armscan.anatomy.Tissues`. Default: `pixels`.
            pixel_mm: Pixel size (across, depth) in mm, for tissues that are clustered by millimetres. Default:
                (0.27, 0.55).

        Raises:
            InvalidValueError: If the slice is not a 2-D array of integers, or `tissues` or `pixel_mm` is not as above.
        """
        slice_xz = _checked_slice(slice_xz)
        rules = [(tissue.label, *tissue.neighbourhood(pixel_mm)) for tissue in check_tissues(tissues)]
        return cls(*(Clusters(*cluster_label(slice_xz, *rule)) for rule in rules))

    def each(self) -> tuple[Clusters, Clusters, Clusters]:
        """Return the tissues in their fixed order: bones, tendons, artery."""
        return self.bones, self.tendons, self.artery

    @property
    def counts(self) -> tuple[int, int, int]:
        """Number of clusters of bones, tendons and artery."""
        return len(self.bones), len(self.tendons), len(self.artery)

    @property
    def landmarks(self) -> Landmarks:
        """The summary that rewards are computed from, shape (3, 4)."""
        return np.array([[len(tissue), tissue.n_pixels, *tissue.mean_centre] for tissue in self.each()])


def tissue_dice(slice_xz: NDArray[np.uint8], reference_xz: NDArray[np.uint8]) -> dict[str, float]:
    """Return the Dice coefficient of each landmark tissue in two slices of one shape, by its name.

    It is twice the number of pixels of the tissue that both slices share, over the sum of its pixels in each: 1 if they
    are the same, 0 if none is shared. If neither slice shows the tissue, it is 1.

    Args:
        slice_xz: Labels of the slice, indexed [across, depth].
        reference_xz: Labels of the reference slice, indexed [across, depth].
    """
    dice = {}
    for label in LANDMARK_LABELS:
        mask, reference = slice_xz == label, reference_xz == label
        total = int(np.count_nonzero(mask) + np.count_nonzero(reference))
        dice[LABEL_NAMES[label]] = 2.0 * int(np.count_nonzero(mask & reference)) / total if total else 1.0
    return dice


def nerve_area_error(
    slice_xz: NDArray[np.uint8], reference_xz: NDArray[np.uint8], pixel_mm: tuple[float, float]
) -> tuple[float | None, float | None]:
    """Return the absolute error of the median nerve's area against a reference slice's: in mm2, and in per cent of it.

    Args:
        slice_xz: Labels of the slice, indexed [across, depth].
        reference_xz: Labels of the reference slice, indexed [across, depth].
        pixel_mm: Pixel size of both slices, (across, depth) in mm.

    Returns:
        Both errors, at least 0; None and None if the reference shows no nerve.
    """
    shown, wanted = (int(np.count_nonzero(each == TISSUE_LABELS["nerve"])) for each in (slice_xz, reference_xz))
    if wanted == 0:
        return None, None
    off = abs(shown - wanted)
    return off * pixel_mm[0] * pixel_mm[1], 100.0 * off / wanted


def _checked_slice(slice_xz: Any) -> NDArray[Any]:
    try:
        checked = np.asarray(slice_xz)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"the slice is {slice_xz!r}, but it must be an array ({error})") from error
    if checked.ndim != 2 or checked.dtype.kind not in "iu":
        raise InvalidValueError(
            f"the slice is an array of shape {checked.shape} and type {checked.dtype}, "
            "but it must be 2-D (across, depth) and hold integer labels"
        )
    return checked

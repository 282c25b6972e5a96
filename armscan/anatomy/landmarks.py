"""What is seen in a slice: the clusters of each landmark tissue, and their summary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from armscan.anatomy.clustering import cluster_label
from armscan.anatomy.tissues import ARTERY, BONES, TENDONS, USUAL_PIXEL_MM, Tissue, check_tissue
from armscan.errors import InvalidValueError

Landmarks = NDArray[np.float64]
"""Summary of a slice, shape (3, 4): a row for bones, tendons and artery, each with the number of clusters, the number
of pixels in them, and the mean of the clusters' centres, (across, depth) in pixels, 0 where there is no cluster."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """The clusters of one tissue in one slice.

    Args:
        image: cluster number of each pixel, from 1; 0 for noise and background. Shape of the slice.
        centres: mean pixel coordinate of each cluster, shape (n, 2), (across, depth).
        sizes: pixels of each cluster, shape (n,).
    """

    image: NDArray[np.int32]
    centres: NDArray[np.float64]
    sizes: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.sizes)

    @property
    def n_points(self) -> int:
        """Number of pixels that belong to a cluster."""
        return int(self.sizes.sum())

    @property
    def mean_centre(self) -> NDArray[np.float64]:
        """Mean of the clusters' centres, (across, depth) in pixels; zeros where there is no cluster."""
        return self.centres.mean(axis=0) if len(self) else np.zeros(2)

    @classmethod
    def of_tissue(
        cls, slice_xz: NDArray[np.uint8], tissue: Tissue, pixel_mm: tuple[float, float] = USUAL_PIXEL_MM
    ) -> Self:
        """Clusters the pixels of one tissue.

        Raises:
            InvalidValueError: if the slice is not a 2-D array of integers, or the tissue is none.
        """
        neighbourhood = check_tissue("tissue", tissue).neighbourhood(pixel_mm)
        return cls(*cluster_label(_checked_slice(slice_xz), tissue.label, *neighbourhood))


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
        *,
        bones: Tissue = BONES,
        tendons: Tissue = TENDONS,
        artery: Tissue = ARTERY,
        pixel_mm: tuple[float, float] = USUAL_PIXEL_MM,
    ) -> Self:
        """Clusters a slice of labels, indexed [across, depth].

        Args:
            slice_xz: integer labels.
            bones: how bones are clustered.
            tendons: how tendons are.
            artery: how the artery is.
            pixel_mm: size of a pixel, (across, depth), for tissues that are clustered by millimetres.

        Raises:
            InvalidValueError: if the slice is not a 2-D array of integers.
        """
        slice_xz = _checked_slice(slice_xz)
        return cls(*(Clusters.of_tissue(slice_xz, tissue, pixel_mm) for tissue in (bones, tendons, artery)))

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
        return np.array([[len(tissue), tissue.n_points, *tissue.mean_centre] for tissue in self.each()])


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

"""What is seen in a slice: the clusters of each landmark tissue, and the reward computed from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from armscan.anatomy.clustering import cluster_label
from armscan.anatomy.tissues import ARTERY, BONES, TENDONS, Tissue
from armscan.checks import check_int
from armscan.errors import InvalidValueError

PUBLISHED_TARGETS = (4, 3, 1)
# Multiplying by it, where a division would do, gives the published figures to the last bit.
THIRD = 1 / 3


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
    def of_tissue(cls, slice_xz: NDArray[np.uint8], tissue: Tissue) -> Self:
        """Clusters the pixels of one tissue."""
        return cls(*cluster_label(slice_xz, tissue.label, float(tissue.eps_px), tissue.min_samples))


@dataclass(frozen=True, eq=False)
class TissueClusters:
    """The clusters of every landmark tissue in one slice."""

    bones: Clusters
    tendons: Clusters
    artery: Clusters

    @classmethod
    def from_slice(
        cls, slice_xz: NDArray[np.uint8], *, bones: Tissue = BONES, tendons: Tissue = TENDONS, artery: Tissue = ARTERY
    ) -> Self:
        """Clusters a slice of labels, indexed [across, depth].

        Raises:
            InvalidValueError: if the slice is not a 2-D array of integers.
        """
        slice_xz = np.asarray(slice_xz)
        if slice_xz.ndim != 2 or not np.issubdtype(slice_xz.dtype, np.integer):
            raise InvalidValueError(
                f"the slice is an array of shape {slice_xz.shape} and type {slice_xz.dtype}, "
                "but it must be 2-D (across, depth) and hold integer labels"
            )
        return cls(*(Clusters.of_tissue(slice_xz, tissue) for tissue in (bones, tendons, artery)))

    def each(self) -> tuple[Clusters, Clusters, Clusters]:
        """Returns the tissues in their fixed order: bones, tendons, artery."""
        return self.bones, self.tendons, self.artery

    @property
    def counts(self) -> tuple[int, int, int]:
        """Number of clusters of bones, tendons and artery."""
        return len(self.bones), len(self.tendons), len(self.artery)


def landmark_reward(clusters: TissueClusters, targets: Sequence[int] = PUBLISHED_TARGETS) -> float:
    """Rewards what can be seen in a slice, in [-1, 0]; 0 where every landmark is there and in its place.

    The mean of three terms, each 0 at best: how far the cluster counts are from their targets (over the targets' sum),
    the share of tissues with no cluster, and 1 where the tendons are not between the bones and the single artery in
    depth.

    Args:
        clusters: what the slice shows.
        targets: how many clusters of bones, tendons and artery the wanted plane shows.

    Raises:
        InvalidValueError: if `targets` is not three whole numbers of at least 1.
    """
    targets = checked_targets(targets)
    landmarks = sum(abs(count - target) for count, target in zip(clusters.counts, targets, strict=True))
    missing = sum(count == 0 for count in clusters.counts)
    location = 0 if _tendons_lie_between(clusters) else 1
    return max(-1.0, 0.0 - (landmarks / sum(targets) + missing / 3 + location) * THIRD)


def checked_targets(targets: Sequence[int]) -> tuple[int, int, int]:
    """Returns the targets as a tuple of three ints, each at least 1."""
    if isinstance(targets, str) or not isinstance(targets, Sequence) or len(targets) != 3:
        raise InvalidValueError(f"targets is {targets!r}, but it must be 3 whole numbers (bones, tendons, artery)")
    bones, tendons, artery = (check_int("each of targets", target, at_least=1) for target in targets)
    return bones, tendons, artery


def _tendons_lie_between(clusters: TissueClusters) -> bool:
    n_bones, n_tendons, n_artery = clusters.counts
    if n_bones == 0 or n_tendons == 0 or n_artery != 1:
        return False
    bones, tendons, artery = (float(tissue.mean_centre[1]) for tissue in clusters.each())
    return bones < tendons < artery or artery < tendons < bones

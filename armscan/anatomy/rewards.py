"""Rewards of a slice, computed from the summary of its clusters; each in [-1, 0], 0 at best."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from typing import NamedTuple, Protocol, Self

import numpy as np

from armscan.anatomy.landmarks import Landmarks, TissueClusters
from armscan.anatomy.tissues import N_TISSUES, PIXEL_TISSUES, USUAL_PIXEL_MM, Tissues
from armscan.errors import InvalidValueError, OptimalPlaneError
from armscan.utils.validation import check_float, check_ints
from armscan.volumes.volume import LabelVolume

PUBLISHED_TARGETS = (4, 3, 1)
# Default of an environment, in which a reward above -success_threshold is a success.
SUCCESS_THRESHOLD = 0.05
# Multiplying by it, instead of dividing, reproduces the published figures to the last bit.
THIRD = 1 / 3


class Reward(Protocol):
    """Scores slices; implement both methods for a reward of your own."""

    def fit(self, volumes: Iterable[LabelVolume], tissues: Tissues = PIXEL_TISSUES) -> Reward:
        """Return the reward fitted to the labelled planes of training volumes; a fitted one is returned unchanged.

        `tissues` holds the clustering rules for their slices.
        """

    def score(self, landmarks: Landmarks, pixel_mm: tuple[float, float]) -> float:
        """Return the reward, in [-1, 0], of a slice with this summary and pixels of (across, depth) mm."""


class LandmarkReward:
    """The published reward: 0 where every landmark is there and in its place.

    It is minus the mean of three penalties, at least -1: how far the cluster counts are from their targets (over the
    targets' sum), the fraction of tissues without a cluster, and 1 if the tendons are not between the bones and the
    single artery in depth.

    Args:
        targets: Target counts: clusters of bones, tendons and artery on a labelled plane, each from 1 to 1000;
            (7, 5, 1) in the other published description. Default: (4, 3, 1).

    Raises:
        InvalidValueError: If `targets` is not three whole numbers from 1 to 1000.
    """

    def __init__(self, targets: Sequence[int] = PUBLISHED_TARGETS) -> None:
        self.targets = check_targets(targets)

    def fit(self, volumes: Iterable[LabelVolume], tissues: Tissues = PIXEL_TISSUES) -> Self:
        """Return the reward unchanged: it needs no fitting."""
        return self

    def score(self, landmarks: Landmarks, pixel_mm: tuple[float, float]) -> float:
        """See `Reward.score`."""
        (n_bones, _, _, bones), (n_tendons, _, _, tendons), (n_artery, _, _, artery) = landmarks.tolist()
        for_bones, for_tendons, for_artery = self.targets
        off_target = abs(n_bones - for_bones) + abs(n_tendons - for_tendons) + abs(n_artery - for_artery)
        missing = (n_bones == 0) + (n_tendons == 0) + (n_artery == 0)
        in_place = missing == 0 and n_artery == 1 and (bones < tendons < artery or artery < tendons < bones)
        return float(max(-1.0, 0.0 - (off_target / sum(self.targets) + missing / 3 + (not in_place)) * THIRD))


class AgreementReward(LandmarkReward):
    """The mean of the published reward and the agreement of sizes and positions with the labelled planes.

    With free rotations, the published reward can be 0 more than 15 mm or 50 degrees from a labelled plane. The
    agreement rates seven features of a slice: the clustered area of each tissue, and how far the mean centres of
    tendons and artery are from the bones', across and in depth. A feature costs nothing inside the range that the
    labelled planes of the training volumes span; outside, its cost rises to at most 1. A distance costs 1 if a tissue
    is absent. The agreement is minus the mean cost: 0 on each of these planes.

    Distances are unsigned and between tissues, so that they are the same for left and right hands, and do not change
    when the slice is shifted.

    Args:
        targets: Target counts of the published reward, each from 1 to 1000. Default: (4, 3, 1).
        area_tolerance: Distance outside its range at which an area costs 1, as a fraction of the nearer end, from 0.001
            to 1000. Default: 0.5.
        distance_tolerance_mm: Distance outside its range, in mm, at which a distance costs 1, from 0.001 to 1000.
            Default: 5.
        slack: Widening of an area's range at each end, as a fraction of that end, from 0 to 1: the pixels of one plane
            differ slightly between motions of the volume. Default: 0.1.
        slack_mm: Widening of a distance's range at each end, in mm, from 0 to 1000. Default: 0.5.

    Raises:
        InvalidValueError: If a value is out of its range.
    """

    def __init__(
        self,
        targets: Sequence[int] = PUBLISHED_TARGETS,
        *,
        area_tolerance: float = 0.5,
        distance_tolerance_mm: float = 5.0,
        slack: float = 0.1,
        slack_mm: float = 0.5,
    ) -> None:
        super().__init__(targets)
        self.area_tolerance = check_float("area_tolerance", area_tolerance, at_least=0.001, at_most=1000.0)
        self.distance_tolerance_mm = check_float(
            "distance_tolerance_mm", distance_tolerance_mm, at_least=0.001, at_most=1000.0
        )
        self.slack = check_float("slack", slack, at_least=0.0, at_most=1.0)
        self.slack_mm = check_float("slack_mm", slack_mm, at_least=0.0, at_most=1000.0)
        self._ranges: list[Range] | None = None

    def fit(self, volumes: Iterable[LabelVolume], tissues: Tissues = PIXEL_TISSUES) -> Self:
        """See `Reward.fit`.

        Raises:
            OptimalPlaneError: If a volume has no labelled plane, or a tissue has no cluster on it.
        """
        if self._ranges is not None:
            return self
        try:
            volumes = list(volumes)
        except TypeError as error:
            raise InvalidValueError(f"volumes is {volumes!r}, but it must be a list of LabelVolumes") from error
        features = np.array([self._labelled_features(volume, tissues) for volume in volumes])
        if not len(features):
            raise InvalidValueError("volumes is empty, but a reward is fitted to at least one")
        fitted = copy(self)
        fitted._ranges = [
            self._range(lowest, highest, is_area=feature < N_TISSUES)
            for feature, (lowest, highest) in enumerate(zip(features.min(axis=0), features.max(axis=0), strict=True))
        ]
        return fitted

    def score(self, landmarks: Landmarks, pixel_mm: tuple[float, float]) -> float:
        """See `Reward.score`.

        Raises:
            InvalidValueError: If the reward has not been fitted to volumes.
        """
        if self._ranges is None:
            raise InvalidValueError("the reward has no ranges yet: call fit(volumes) with the training volumes")
        costs = 0.0
        for feature, range_ in zip(_features(landmarks, pixel_mm), self._ranges, strict=True):
            costs += 1.0 if feature is None else range_.cost(feature)
        return 0.5 * (super().score(landmarks, pixel_mm) - costs / len(self._ranges))

    def _range(self, lowest: float, highest: float, *, is_area: bool) -> Range:
        if is_area:
            return Range(
                (1.0 - self.slack) * lowest,
                (1.0 + self.slack) * highest,
                self.area_tolerance * lowest,
                self.area_tolerance * highest,
            )
        tolerance = self.distance_tolerance_mm
        return Range(lowest - self.slack_mm, highest + self.slack_mm, tolerance, tolerance)

    @staticmethod
    def _labelled_features(volume: LabelVolume, tissues: Tissues) -> list[float]:
        if not isinstance(volume, LabelVolume):
            raise InvalidValueError(f"volumes holds {volume!r}, but each must be a LabelVolume")
        if volume.optimal_action is None:
            raise OptimalPlaneError(f"{volume.name}: has no labelled plane, which the reward is fitted to")
        slice_xz = volume.slice(volume.optimal_action)
        clusters = TissueClusters.from_slice(slice_xz, tissues, volume.pixel_mm)
        features = _features(clusters.landmarks, volume.pixel_mm)
        known = [feature for feature in features if feature is not None]
        if len(known) < len(features):
            raise OptimalPlaneError(
                f"{volume.name}: the labelled plane shows {clusters.counts} clusters of bones, tendons and "
                "artery, but a reward can only be fitted to planes that show each of them"
            )
        return known


class Range(NamedTuple):
    """Range in which a feature costs nothing, and distances below and above it at which it costs 1."""

    lowest: float
    highest: float
    below: float
    above: float

    def cost(self, feature: float) -> float:
        """Return the cost of a feature, in [0, 1]."""
        if feature < self.lowest:
            return min(1.0, (self.lowest - feature) / self.below)
        return min(1.0, max(0.0, feature - self.highest) / self.above)


def _features(landmarks: Landmarks, pixel_mm: tuple[float, float]) -> list[float | None]:
    """Return areas of bones, tendons, artery in mm2, distances of tendons, artery to bones in mm, None if absent."""
    across_mm, depth_mm = pixel_mm
    bones, *others = landmarks.tolist()
    features: list[float | None] = [n_pixels * across_mm * depth_mm for _, n_pixels, _, _ in (bones, *others)]
    for count, _, across, depth in others:
        if count and bones[0]:
            features += [abs(across - bones[2]) * across_mm, abs(depth - bones[3]) * depth_mm]
        else:
            features += [None, None]
    return features


def landmark_reward(clusters: TissueClusters, targets: Sequence[int] = PUBLISHED_TARGETS) -> float:
    """Return the published reward, `LandmarkReward`, of a slice.

    Args:
        clusters: Clusters in the slice.
        targets: Target counts of bones, tendons and artery; see `LandmarkReward`. Default: (4, 3, 1).

    Raises:
        InvalidValueError: If `targets` is not three whole numbers from 1 to 1000, or `clusters` is not a
            `TissueClusters`.
    """
    if not isinstance(clusters, TissueClusters):
        raise InvalidValueError(f"clusters is {clusters!r}, but it must be a TissueClusters")
    return LandmarkReward(targets).score(clusters.landmarks, USUAL_PIXEL_MM)


def check_targets(targets: Sequence[int]) -> tuple[int, int, int]:
    """Return the targets as a tuple of three ints, each from 1 to 1000."""
    bones, tendons, artery = check_ints("targets", targets, 3, "(bones, tendons, artery)", at_least=1, at_most=1000)
    return bones, tendons, artery


def fitted_reward(
    reward: Reward | None, targets: Sequence[int], volumes: Iterable[LabelVolume], tissues: Tissues
) -> Reward:
    """Return a reward, or the published one with these targets if it is None, fitted to volumes.

    Raises:
        InvalidValueError: If targets and a reward are both given, or if the reward, or what its `fit` returns, is not a
            reward.
    """
    targets = check_targets(targets)
    if reward is None:
        return LandmarkReward(targets)
    if targets != PUBLISHED_TARGETS:
        raise InvalidValueError(f"targets is {targets} and a reward is given, too, but only one of them may be")
    if not _is_reward(reward):
        raise InvalidValueError(f"reward is {reward!r}, but it must be an object with the methods of Reward")
    fitted = reward.fit(volumes, tissues)
    if not _is_reward(fitted):
        raise InvalidValueError(
            f"{type(reward).__name__}.fit returned {fitted!r}, but it must return a fitted reward, such as itself"
        )
    return fitted


def _is_reward(reward: object) -> bool:
    return not isinstance(reward, type) and all(callable(getattr(reward, name, None)) for name in ("fit", "score"))

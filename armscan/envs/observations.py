"""Observations: named parts, each with its space, that can be merged."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.anatomy import PUBLISHED_TARGETS, USUAL_PIXEL_MM, Landmarks, TissueClusters, Tissues, check_targets
from armscan.envs.spaces import Parts
from armscan.errors import InvalidValueError
from armscan.utils.arrays import FloatArray
from armscan.utils.compilation import cached_njit
from armscan.utils.validation import check_bool

# Typical areas of bones, tendons and artery at the usual pixel size.
USUAL_AREAS_PX = (3000.0, 1000.0, 100.0)
CENTRE_SCALE_MM = (25.0, 12.0)


class SliceGeometry(NamedTuple):
    """Shape (across, depth) in pixels and pixel size in mm of the slices of one volume."""

    shape: tuple[int, int]
    pixel_mm: tuple[float, float]


def smallest_shape(shapes: Collection[tuple[int, int]]) -> tuple[int, int]:
    """Return the largest shape, (across, depth), that fits into slices of all these shapes."""
    across, depth = zip(*shapes, strict=True)
    return min(across), min(depth)


@dataclass(eq=False)
class View:
    """View of the environment at one step, from which observations are computed.

    Args:
        slice_xz: Labels of the slice, indexed [across, depth].
        landmarks: Summary of its clusters, shape (3, 4).
        tissues: Clustering rule of each tissue.
        geometry: Shape and pixel size of the slice.
        smallest_shape: Largest shape that fits into the slices of all volumes, (across, depth) in pixels.
        action: Last action, normalised, shape (n_action,): its free components, and `stop` if `ends` is `on_stop`.
        reward: Reward of the slice, in [-1, 0].
    """

    slice_xz: NDArray[np.uint8]
    landmarks: Landmarks
    tissues: Tissues
    geometry: SliceGeometry
    smallest_shape: tuple[int, int]
    action: FloatArray
    reward: float

    @cached_property
    def clusters(self) -> TissueClusters:
        """The clusters themselves, computed on first access."""
        return TissueClusters.from_slice(self.slice_xz, self.tissues, self.geometry.pixel_mm)


class Observation(Protocol):
    """A set of named parts that the agent sees; implement both methods for an observation of your own."""

    def spaces(self, geometries: Sequence[SliceGeometry], n_action: int) -> dict[str, spaces.Box]:
        """Return the space of each part, for every geometry that can occur and actions of `n_action` components."""

    def observe(self, view: View) -> Parts:
        """Return the value of each part, within its space, in arrays that are not reused."""


def observe_all(observation: Observation, views: Sequence[View]) -> Parts:
    """Return the parts of an observation for many views at once, shape (n_views, ...).

    A custom observation without a method `observe_all(views)` is called view by view.
    """
    # Not by `isinstance` with a protocol, which takes longer than observing.
    if (observe_them := getattr(observation, "observe_all", None)) is not None:
        parts: Parts = observe_them(views)
        return parts
    observed = [observation.observe(view) for view in views]
    for parts in observed:
        check_mapping(observation, parts)
    return {name: np.stack([parts[name] for parts in observed]) for name in observed[0]}


def check_mapping(observation: Observation, parts: object) -> None:
    """Raise `InvalidValueError` if what an observation returned is no mapping."""
    if not isinstance(parts, Mapping):
        name = type(observation).__name__
        raise InvalidValueError(f"{name}.observe returned {parts!r}, but it must return an array for each part")


class ActionRewardObservation:
    """The last normalised action, shape (n_action,), and the reward of the current slice, shape (1,)."""

    def spaces(self, geometries: Sequence[SliceGeometry], n_action: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`."""
        return {
            "action": spaces.Box(-1.0, 1.0, (n_action,), np.float32),
            "reward": spaces.Box(-1.0, 0.0, (1,), np.float32),
        }

    def observe(self, view: View) -> Parts:
        """See `Observation.observe`."""
        return {"action": view.action.astype(np.float32), "reward": np.array([view.reward], dtype=np.float32)}

    def observe_all(self, views: Sequence[View]) -> Parts:
        """See `observe_all`."""
        return {
            "action": np.array([view.action for view in views], dtype=np.float32),
            "reward": np.array([[view.reward] for view in views], dtype=np.float32),
        }


class ClusterObservation:
    """For each tissue (bones, tendons, artery): clusters, clustered pixels, mean of the centres; shape (12,).

    In the normalised form, counts are divided by their targets, pixels by the tissue's typical area, and the centre's
    offset from the slice's middle by (25, 12) mm; all are 0 if the tissue is absent, and near [-1, 1] otherwise. The
    raw form has the plain numbers, the centre in pixels. Agents learn much faster with the normalised form.

    Args:
        normalised: Whether to return the normalised form; False: the raw one, as published, with which agents learn
            much more slowly. Default: True.
        targets: Divisors of the counts. Default: None, (4, 3, 1).
    """

    def __init__(self, *, normalised: bool = True, targets: Sequence[int] | None = None) -> None:
        self.normalised = check_bool("normalised", normalised)
        self._targets = check_targets(PUBLISHED_TARGETS if targets is None else targets)
        self._scales: dict[SliceGeometry, tuple[FloatArray, FloatArray]] = {}

    def spaces(self, geometries: Sequence[SliceGeometry], n_action: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`."""
        most = [self._features(_most_landmarks(geometry)[None], geometry) for geometry in geometries]
        highest = np.max(most, axis=0).reshape(-1, 4)
        lowest = np.zeros_like(highest)
        if self.normalised:
            lowest[:, 2:] = -highest[:, 2:]
        return {"clusters": spaces.Box(lowest.ravel(), highest.ravel(), dtype=np.float32)}

    def observe(self, view: View) -> Parts:
        """See `Observation.observe`."""
        return {"clusters": self._features(view.landmarks[None], view.geometry)[0]}

    def observe_all(self, views: Sequence[View]) -> Parts:
        """See `observe_all`."""
        landmarks = np.array([view.landmarks for view in views])
        geometries = [view.geometry for view in views]
        if geometries.count(geometries[0]) == len(geometries):
            return {"clusters": self._features(landmarks, geometries[0])}
        features = [self._features(each[None], of)[0] for each, of in zip(landmarks, geometries, strict=True)]
        return {"clusters": np.array(features)}

    def _features(self, landmarks: FloatArray, geometry: SliceGeometry) -> NDArray[np.float32]:
        """Return the features, shape (n, 12), of summaries of clusters, shape (n, 3, 4), in the chosen form."""
        if not self.normalised:
            return landmarks.reshape(len(landmarks), -1).astype(np.float32)
        if geometry not in self._scales:
            self._scales[geometry] = self._scale(geometry)
        features = np.empty((len(landmarks), landmarks[0].size), dtype=np.float32)
        _normalise(landmarks, *self._scales[geometry], features)
        return features

    def _scale(self, geometry: SliceGeometry) -> tuple[FloatArray, FloatArray]:
        """Return the offset to subtract from a summary, and the factor to multiply it with, each of shape (3, 4)."""
        zero, scale = np.zeros((3, 4)), np.empty((3, 4))
        zero[:, 2:] = (np.array(geometry.shape) - 1) / 2
        scale[:, 0] = 1.0 / np.array(self._targets)
        scale[:, 1] = np.prod(geometry.pixel_mm) / np.prod(USUAL_PIXEL_MM) / np.array(USUAL_AREAS_PX)
        scale[:, 2:] = np.array(geometry.pixel_mm) / CENTRE_SCALE_MM
        return zero, scale


@cached_njit()
def _normalise(landmarks: FloatArray, zero: FloatArray, scale: FloatArray, features: NDArray[np.float32]) -> None:
    """Fill the features, shape (n, 12), of summaries of clusters, shape (n, 3, 4): 0 where a tissue is absent."""
    n_numbers = landmarks.shape[2]
    for i in range(landmarks.shape[0]):
        for tissue in range(landmarks.shape[1]):
            for k in range(n_numbers):
                feature = (landmarks[i, tissue, k] - zero[tissue, k]) * scale[tissue, k]
                features[i, n_numbers * tissue + k] = 0.0 if landmarks[i, tissue, 0] == 0.0 else feature


def _most_landmarks(geometry: SliceGeometry) -> Landmarks:
    """Return the largest summary that a slice could have, shape (3, 4)."""
    n_across, n_depth = geometry.shape
    # At least 1, so that the space of a slice one pixel thick is not a single point.
    most = [n_across * n_depth, n_across * n_depth, max(1, n_across - 1), max(1, n_depth - 1)]
    return np.array([most] * len(USUAL_AREAS_PX), dtype=float)

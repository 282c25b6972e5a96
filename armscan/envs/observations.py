"""What an agent gets to see: named parts, each with its space, that can be merged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.anatomy import (
    PUBLISHED_TARGETS,
    USUAL_PIXEL_MM,
    Landmarks,
    TissueClusters,
    Tissues,
    checked_targets,
)
from armscan.checks import check_bool
from armscan.envs.spaces import Parts
from armscan.errors import InvalidValueError, listed
from armscan.volumes.plane import FloatArray

# Of bones, tendons and artery, at the usual pixel size.
USUAL_AREAS_PX = (3000.0, 1000.0, 100.0)
CENTRE_SCALE_MM = (25.0, 12.0)


@dataclass(frozen=True)
class SliceGeometry:
    """Shape (across, depth) in pixels and pixel size in mm of the slices of one volume."""

    shape: tuple[int, int]
    pixel_mm: tuple[float, float]


def smallest_shape(geometries: Sequence[SliceGeometry]) -> tuple[int, int]:
    """Returns the shape that slices of every geometry have at least."""
    return min(g.shape[0] for g in geometries), min(g.shape[1] for g in geometries)


@dataclass(eq=False)
class View:
    """What the environment shows an observation at one step.

    Args:
        slice_xz: the slice's labels, indexed [across, depth].
        landmarks: the summary of its clusters, shape (3, 4).
        tissues: how they were clustered.
        geometry: the slice's shape and pixel size.
        smallest_shape: shape that the slices of every volume have at least, (across, depth).
        action: the free components of the last action, normalised, shape (n_free,).
        reward: the reward of the slice.
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
        """The clusters themselves, found again when they are asked for."""
        return TissueClusters.from_slice(self.slice_xz, **self.tissues._asdict(), pixel_mm=self.geometry.pixel_mm)


class Observation(Protocol):
    """A set of named parts of what the agent sees; implement both methods to make one's own."""

    def spaces(self, geometries: Sequence[SliceGeometry], n_free: int) -> dict[str, spaces.Box]:
        """Returns the space of each part, for every geometry that can occur and `n_free` action components."""

    def observe(self, view: View) -> Parts:
        """Returns the value of each part, within its space, in arrays that are not filled again."""


def observe_all(observation: Observation, views: Sequence[View]) -> Parts:
    """Returns the parts of an observation for many views at once, shape (n_views, ...).

    An observation of one's own is asked view by view, unless it has a method `observe_all(views)` too.
    """
    if isinstance(observation, _ObservingAll):
        return observation.observe_all(views)
    observed = [observation.observe(view) for view in views]
    return {name: np.stack([parts[name] for parts in observed]) for name in observed[0]}


@runtime_checkable
class _ObservingAll(Protocol):
    def observe_all(self, views: Sequence[View]) -> Parts: ...


class ActionRewardObservation:
    """The last normalised action, shape (n_free,), and the reward of the current slice, shape (1,)."""

    def spaces(self, geometries: Sequence[SliceGeometry], n_free: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`."""
        return {
            "action": spaces.Box(-1.0, 1.0, (n_free,), np.float32),
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

    Normalised, the counts are over their targets, the pixels over the tissue's usual area, and the centre is in mm
    from the slice's middle over (25, 12) mm, 0 where the tissue is absent: all near [-1, 1]. Raw, they are the plain
    numbers, the centre in pixels. Agents learn in a minute with the normalised form what they never learn with the raw.

    Args:
        normalised: which form.
        targets: what the counts are divided by.
    """

    def __init__(self, *, normalised: bool = True, targets: Sequence[int] = PUBLISHED_TARGETS) -> None:
        self.normalised = check_bool("normalised", normalised)
        self._targets = checked_targets(targets)
        self._scales: dict[SliceGeometry, tuple[FloatArray, FloatArray]] = {}

    def spaces(self, geometries: Sequence[SliceGeometry], n_free: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`."""
        highest = np.max([self._features(_most_landmarks(geometry), geometry) for geometry in geometries], axis=0)
        lowest = np.zeros_like(highest)
        if self.normalised:
            lowest[:, 2:] = -highest[:, 2:]
        return {"clusters": spaces.Box(lowest.ravel(), highest.ravel(), dtype=np.float32)}

    def observe(self, view: View) -> Parts:
        """See `Observation.observe`."""
        return {"clusters": self._features(view.landmarks, view.geometry).ravel()}

    def observe_all(self, views: Sequence[View]) -> Parts:
        """See `observe_all`."""
        landmarks = np.array([view.landmarks for view in views])
        geometries = [view.geometry for view in views]
        if geometries.count(geometries[0]) == len(geometries):
            return {"clusters": self._features(landmarks, geometries[0]).reshape(len(views), -1)}
        features = [self._features(*each) for each in zip(landmarks, geometries, strict=True)]
        return {"clusters": np.array(features).reshape(len(views), -1)}

    def _features(self, landmarks: Landmarks, geometry: SliceGeometry) -> NDArray[np.float32]:
        """Turns summaries of clusters, shape (..., 3, 4), into the wanted form."""
        if not self.normalised:
            return landmarks.astype(np.float32)
        if geometry not in self._scales:
            self._scales[geometry] = self._scale(geometry)
        zero, scale = self._scales[geometry]
        features = (landmarks - zero) * scale
        features[landmarks[..., 0] == 0] = 0.0
        return features.astype(np.float32)

    def _scale(self, geometry: SliceGeometry) -> tuple[FloatArray, FloatArray]:
        """What is subtracted of a summary, and what it is then multiplied by, each shape (3, 4)."""
        zero, scale = np.zeros((3, 4)), np.empty((3, 4))
        zero[:, 2:] = (np.array(geometry.shape) - 1) / 2
        scale[:, 0] = 1.0 / np.array(self._targets)
        scale[:, 1] = np.prod(geometry.pixel_mm) / np.prod(USUAL_PIXEL_MM) / np.array(USUAL_AREAS_PX)
        scale[:, 2:] = np.array(geometry.pixel_mm) / CENTRE_SCALE_MM
        return zero, scale


def _most_landmarks(geometry: SliceGeometry) -> Landmarks:
    """The largest summary that a slice could have, shape (3, 4)."""
    n_across, n_depth = geometry.shape
    # At least 1, so that a slice of one pixel's thickness has a space that is not a single point.
    most = [n_across * n_depth, n_across * n_depth, max(1, n_across - 1), max(1, n_depth - 1)]
    return np.array([most] * len(USUAL_AREAS_PX), dtype=float)


class MergedObservation:
    """Several observations as one.

    Args:
        observations: what to merge, as objects or by name; no two may have a part of the same name.
        targets: what `cluster`, given by name, divides its counts by.

    Raises:
        InvalidValueError: if there is none, or one is no observation.
    """

    def __init__(
        self, observations: Sequence[str | Observation], *, targets: Sequence[int] = PUBLISHED_TARGETS
    ) -> None:
        if isinstance(observations, str) or not isinstance(observations, Sequence) or not observations:
            raise InvalidValueError(f"observations is {observations!r}, but it must be a list of at least one")
        self.observations = tuple(
            member for observation in observations for member in members_of(checked_observation(observation, targets))
        )

    def spaces(self, geometries: Sequence[SliceGeometry], n_free: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`.

        Raises:
            InvalidValueError: if two observations have a part of the same name.
        """
        merged: dict[str, spaces.Box] = {}
        for observation in self.observations:
            parts = observation.spaces(geometries, n_free)
            if twice := sorted(merged.keys() & parts.keys()):
                raise InvalidValueError(f"merged observations both have the key {listed(twice)}")
            merged.update(parts)
        return merged

    def observe(self, view: View) -> Parts:
        """See `Observation.observe`."""
        return {key: part for observation in self.observations for key, part in observation.observe(view).items()}

    def observe_all(self, views: Sequence[View]) -> Parts:
        """See `observe_all`."""
        return {key: part for each in self.observations for key, part in observe_all(each, views).items()}


def named_observations() -> Mapping[str, type[Observation]]:
    """Returns the observations that have a name."""
    # Deferred: the module of the slices builds on this one.
    from armscan.envs.slice_observations import SliceChannelsObservation, SliceObservation

    return {
        "action_reward": ActionRewardObservation,
        "cluster": ClusterObservation,
        "slice": SliceObservation,
        "slice_channels": SliceChannelsObservation,
    }


def members_of(observation: Observation) -> tuple[Observation, ...]:
    """Returns what an observation is merged of, itself where it is not."""
    return observation.observations if isinstance(observation, MergedObservation) else (observation,)


def checked_observation(
    observation: str | Observation | Sequence[str | Observation], targets: Sequence[int] = PUBLISHED_TARGETS
) -> Observation:
    """Returns an observation given as such, by name, or as a list of those that are merged.

    Args:
        observation: likewise.
        targets: what `cluster`, given by name, divides its counts by.

    Raises:
        InvalidValueError: if there is no observation of that name, or it is no observation.
    """
    names = named_observations()
    if isinstance(observation, str) and observation in names:
        return ClusterObservation(targets=targets) if observation == "cluster" else names[observation]()
    if isinstance(observation, list | tuple):
        return MergedObservation(observation, targets=targets)
    has_methods = all(callable(getattr(observation, method, None)) for method in ("spaces", "observe"))
    if isinstance(observation, str | type) or not has_methods:
        raise InvalidValueError(
            f"observation is {observation!r}, but it must be {listed(names)}, a list of them, or an object with the "
            "methods of Observation"
        )
    return observation  # type: ignore[return-value]


def with_action_reward(
    observation: str | Observation | Sequence[str | Observation], targets: Sequence[int] = PUBLISHED_TARGETS
) -> Observation:
    """Returns the observation, as `checked_observation` does, with action and reward, which are part of every one."""
    checked = checked_observation(observation, targets)
    members = members_of(checked)
    if any(isinstance(member, ActionRewardObservation) for member in members):
        return checked
    return MergedObservation([*members, ActionRewardObservation()])

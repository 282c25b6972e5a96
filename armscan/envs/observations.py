"""What an agent gets to see: named parts, each with its space, that can be merged and flattened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.anatomy import PUBLISHED_TARGETS, TISSUES, USUAL_PIXEL_MM, TissueClusters, checked_targets
from armscan.checks import check_bool
from armscan.errors import InvalidValueError, listed
from armscan.volumes.plane import FloatArray

FloatVector = NDArray[np.float32]
CENTRE_SCALE_MM = np.array([25.0, 12.0])


@dataclass(frozen=True)
class SliceGeometry:
    """Shape (across, depth) in pixels and pixel size in mm of the slices of one volume."""

    shape: tuple[int, int]
    pixel_mm: tuple[float, float]


@dataclass(frozen=True, eq=False)
class View:
    """What the environment shows an observation at one step.

    Args:
        slice_xz: the slice's labels, indexed [across, depth].
        clusters: its clusters.
        geometry: its shape and pixel size.
        action: the free components of the last action, normalised, shape (n_free,).
        reward: the reward of the slice.
    """

    slice_xz: NDArray[np.uint8]
    clusters: TissueClusters
    geometry: SliceGeometry
    action: FloatArray
    reward: float


class Observation(Protocol):
    """A set of named parts of what the agent sees; implement both methods to make one's own."""

    def spaces(self, geometries: Sequence[SliceGeometry], n_free: int) -> dict[str, spaces.Box]:
        """Returns the space of each part, for every geometry that can occur and `n_free` action components."""

    def observe(self, view: View) -> dict[str, FloatVector]:
        """Returns the value of each part, within its space."""


class ActionRewardObservation:
    """The last normalised action, shape (n_free,), and the reward of the current slice, shape (1,)."""

    def spaces(self, geometries: Sequence[SliceGeometry], n_free: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`."""
        return {
            "action": spaces.Box(-1.0, 1.0, (n_free,), np.float32),
            "reward": spaces.Box(-1.0, 0.0, (1,), np.float32),
        }

    def observe(self, view: View) -> dict[str, FloatVector]:
        """See `Observation.observe`."""
        return {"action": view.action.astype(np.float32), "reward": np.array([view.reward], dtype=np.float32)}


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

    def spaces(self, geometries: Sequence[SliceGeometry], n_free: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`."""
        highest = np.max([self._features(self._most(geometry), geometry) for geometry in geometries], axis=0)
        lowest = np.zeros_like(highest)
        if self.normalised:
            lowest[:, 2:] = -highest[:, 2:]
        return {"clusters": spaces.Box(lowest.ravel(), highest.ravel(), dtype=np.float32)}

    def observe(self, view: View) -> dict[str, FloatVector]:
        """See `Observation.observe`."""
        raw = np.array([[len(tissue), tissue.n_points, *tissue.mean_centre] for tissue in view.clusters.each()])
        return {"clusters": self._features(raw, view.geometry).ravel()}

    @staticmethod
    def _most(geometry: SliceGeometry) -> FloatArray:
        """The largest raw features that a slice could have, shape (3, 4)."""
        n_pixels = geometry.shape[0] * geometry.shape[1]
        return np.array(
            [[n_pixels, n_pixels, geometry.shape[0] - 1, geometry.shape[1] - 1]] * len(TISSUES), dtype=float
        )

    def _features(self, raw: FloatArray, geometry: SliceGeometry) -> FloatVector:
        """Turns raw features, shape (3, 4), into the wanted form."""
        if not self.normalised:
            return raw.astype(np.float32)
        features = raw.copy()
        features[:, 0] /= self._targets
        pixel_scale = np.prod(geometry.pixel_mm) / np.prod(USUAL_PIXEL_MM)
        features[:, 1] *= pixel_scale / np.array([tissue.usual_area_px for tissue in TISSUES])
        middle_px = (np.array(geometry.shape) - 1) / 2
        centres = (raw[:, 2:] - middle_px) * geometry.pixel_mm / CENTRE_SCALE_MM
        features[:, 2:] = np.where(raw[:, :1] > 0, centres, 0.0)
        return features.astype(np.float32)


class MergedObservation:
    """Several observations as one.

    Args:
        observations: what to merge; no two may have a part of the same name.
    """

    def __init__(self, observations: Sequence[Observation]) -> None:
        self.observations = tuple(observations)

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

    def observe(self, view: View) -> dict[str, FloatVector]:
        """See `Observation.observe`."""
        return {key: part for observation in self.observations for key, part in observation.observe(view).items()}


OBSERVATIONS: Mapping[str, type[ActionRewardObservation] | type[ClusterObservation]] = {
    "action_reward": ActionRewardObservation,
    "cluster": ClusterObservation,
}


def with_action_reward(observation: str | Observation) -> Observation:
    """Returns the observation, given as such or by name, with action and reward, which are part of every one.

    Raises:
        InvalidValueError: if there is no observation of that name.
    """
    if isinstance(observation, str):
        if observation not in OBSERVATIONS:
            raise InvalidValueError(f"observation is {observation!r}, but it must be {listed(OBSERVATIONS)}")
        observation = OBSERVATIONS[observation]()
    is_class = isinstance(observation, type)
    if (
        is_class
        or not callable(getattr(observation, "spaces", None))
        or not callable(getattr(observation, "observe", None))
    ):
        raise InvalidValueError(
            f"observation is {observation!r}, but it must be {listed(OBSERVATIONS)}, or an object with the methods of "
            "Observation"
        )
    if isinstance(observation, ActionRewardObservation):
        return observation
    return MergedObservation([observation, ActionRewardObservation()])


def flat_space(parts: Mapping[str, spaces.Box]) -> spaces.Box:
    """Returns the space of the flattened parts, in their order."""
    low = np.concatenate([space.low.ravel() for space in parts.values()])
    high = np.concatenate([space.high.ravel() for space in parts.values()])
    return spaces.Box(low, high, dtype=np.float32)


def flattened(parts: Mapping[str, FloatVector]) -> FloatVector:
    """Returns the parts as one vector, in the order of `flat_space`."""
    return np.concatenate([part.ravel() for part in parts.values()])

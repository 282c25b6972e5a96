"""Observations by name, and merged ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from gymnasium import spaces

from armscan.anatomy import PUBLISHED_TARGETS
from armscan.envs.metric_slice import MetricSliceObservation
from armscan.envs.observations import (
    ActionRewardObservation,
    ClusterObservation,
    Observation,
    SliceGeometry,
    View,
    check_mapping,
    observe_all,
)
from armscan.envs.slice_observations import SliceChannelsObservation, SliceObservation
from armscan.envs.spaces import Parts
from armscan.errors import InvalidValueError, listed

# An observation as users give it: an object, a name, or a list of these to merge.
ObservationLike = str | Observation | Sequence["ObservationLike"]


class MergedObservation:
    """Several observations as one.

    Args:
        observations: Observations to merge, as objects or by name; no two may have a part of the same name.
        targets: Numbers that `cluster`, given by name, divides its counts by. Default: (4, 3, 1).

    Raises:
        InvalidValueError: If there are none, or one is not an observation.
    """

    def __init__(self, observations: Sequence[ObservationLike], *, targets: Sequence[int] = PUBLISHED_TARGETS) -> None:
        if isinstance(observations, str) or not isinstance(observations, Sequence) or not observations:
            raise InvalidValueError(f"observations is {observations!r}, but it must be a list of at least one")
        # Filled by `spaces`, before which nothing is checked.
        self._boxes: dict[str, spaces.Box] = {}
        checked = [_observation(observation, targets) for observation in observations]
        self.observations: tuple[Observation, ...] = tuple(
            member
            for each in checked
            for member in (each.observations if isinstance(each, MergedObservation) else (each,))
        )

    def spaces(self, geometries: Sequence[SliceGeometry], n_action: int) -> dict[str, spaces.Box]:
        """See `Observation.spaces`.

        Raises:
            InvalidValueError: If two observations have a part of the same name.
        """
        merged: dict[str, spaces.Box] = {}
        for observation in self.observations:
            parts = observation.spaces(geometries, n_action)
            if not isinstance(parts, Mapping):
                raise InvalidValueError(
                    f"{type(observation).__name__}.spaces returned {parts!r}, but it must return a Box for each part"
                )
            if twice := sorted(merged.keys() & parts.keys()):
                raise InvalidValueError(f"merged observations both have the key {listed(twice)}")
            merged.update(parts)
        self._boxes = merged
        return merged

    def observe(self, view: View) -> Parts:
        """See `Observation.observe`."""
        of_each = [self._checked(each, each.observe(view)) for each in self.observations]
        return {key: part for parts in of_each for key, part in parts.items()}

    def observe_all(self, views: Sequence[View]) -> Parts:
        """See `observe_all`."""
        of_each = [self._checked(each, observe_all(each, views)) for each in self.observations]
        return {key: part for parts in of_each for key, part in parts.items()}

    def _checked(self, observation: Observation, parts: Parts) -> Parts:
        """Return the parts of an observation; those of a user's own must lie in their spaces."""
        if type(observation) in OURS:
            return parts
        check_mapping(observation, parts)
        for key, part in parts.items():
            box, values = self._boxes.get(key), np.asarray(part)
            # Missing parts and wrong shapes are reported when the observation is put together.
            if box is None or values.shape[values.ndim - len(box.shape) :] != box.shape:
                continue
            has_fitting_dtype = np.issubdtype(box.dtype, np.floating) or np.issubdtype(values.dtype, np.integer)
            # A NaN is not within any bounds.
            if not has_fitting_dtype or not ((box.low <= values) & (values <= box.high)).all():
                raise InvalidValueError(
                    f"{type(observation).__name__}.observe gave {values!r} as {key}, but its space is {box}"
                )
        return parts


NAMED_OBSERVATIONS: dict[str, type[Observation]] = {
    "action_reward": ActionRewardObservation,
    "cluster": ClusterObservation,
    "slice": SliceObservation,
    "slice_channels": SliceChannelsObservation,
    "slice_metric": MetricSliceObservation,
}


OURS = frozenset(NAMED_OBSERVATIONS.values())


def with_action_reward(observation: ObservationLike, targets: Sequence[int] = PUBLISHED_TARGETS) -> Observation:
    """Return an observation with action and reward, added if it lacks them; `targets` are for `cluster`."""
    merged = MergedObservation([observation], targets=targets)
    if any(isinstance(member, ActionRewardObservation) for member in merged.observations):
        return merged
    return MergedObservation([*merged.observations, ActionRewardObservation()])


def _observation(observation: ObservationLike, targets: Sequence[int]) -> Observation:
    if isinstance(observation, str) and observation in NAMED_OBSERVATIONS:
        return ClusterObservation(targets=targets) if observation == "cluster" else NAMED_OBSERVATIONS[observation]()
    if isinstance(observation, list | tuple):
        return MergedObservation(observation, targets=targets)
    has_methods = all(callable(getattr(observation, method, None)) for method in ("spaces", "observe"))
    if isinstance(observation, str | type) or not has_methods:
        raise InvalidValueError(
            f"observation is {observation!r}, but it must be {listed(NAMED_OBSERVATIONS)}, a list of them, or an "
            "object with the methods of Observation"
        )
    return observation  # type: ignore[return-value]

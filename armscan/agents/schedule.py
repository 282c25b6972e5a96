"""Schedules: hyperparameters of an agent that change at given environment steps of its training."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from armscan.agents.protocols import Algorithm
from armscan.errors import InvalidValueError, listed
from armscan.utils.validation import check_int

KEY, FROM, AGENT = "training.schedule", "from_env_steps", "agent."


@dataclass(frozen=True)
class Segment:
    """A part of a training with changed hyperparameters.

    Args:
        from_env_steps: Start: it applies from the first epoch that begins at or after this environment step.
        values: Changed values, by the names of the algorithm's fields.
    """

    from_env_steps: int
    values: Mapping[str, Any]


def read_schedule(described: Any, total_env_steps: int) -> tuple[Segment, ...]:
    """Return the segments of a schedule.

    Args:
        described: Mappings such as `{from_env_steps: 4000, agent.lr: 0.001}`, in order; None for no change.
        total_env_steps: Budget of the training, in environment steps; each segment begins before it.

    Raises:
        InvalidValueError: If it is not such a list, or its segments are not in order.
    """
    if described is None:
        return ()
    if not isinstance(described, list | tuple) or not all(isinstance(each, Mapping) for each in described):
        raise InvalidValueError(
            f"{KEY} is {described!r}, but it must be null or a list such as [{{{FROM}: 4000, agent.lr: 0.001}}]"
        )
    segments: list[Segment] = []
    for number, each in enumerate(described):
        of_each, after = f"{KEY}[{number}]", segments[-1].from_env_steps if segments else 0
        start = check_int(f"{of_each}.{FROM}", each.get(FROM), at_least=after + 1, at_most=total_env_steps - 1)
        if wrong := [key for key in each if key != FROM and not str(key).startswith(AGENT)]:
            raise InvalidValueError(f"there is no key {wrong[0]!r} in {of_each}, but only {FROM} and keys of agent")
        if len(each) == 1:
            raise InvalidValueError(f"{of_each} changes nothing: give keys of agent, such as {AGENT}lr, beside {FROM}")
        segments.append(Segment(start, {key.removeprefix(AGENT): each[key] for key in each if key != FROM}))
    return tuple(segments)


def scheduled_algorithms(algorithm: Algorithm, schedule: Sequence[Segment]) -> list[tuple[int, Algorithm]]:
    """Return the algorithm with the values of each segment, and the environment step at which it begins.

    A value lasts until another segment changes it.

    Raises:
        InvalidValueError: If a segment changes what cannot change during a training, or a value is not allowed.
    """
    allowed = getattr(algorithm, "SCHEDULABLE", ())
    algorithms: list[tuple[int, Algorithm]] = []
    for number, segment in enumerate(schedule):
        if wrong := [name for name in segment.values if name not in allowed]:
            keys = listed([f"{AGENT}{name}" for name in allowed]) if allowed else "nothing"
            raise InvalidValueError(
                f"{KEY}[{number}] changes {AGENT}{wrong[0]}, but during a training of "
                f"{type(algorithm).__name__} only this can change: {keys}"
            )
        pretraining = getattr(algorithm, "pretraining_env_steps", None)
        if pretraining is not None and segment.from_env_steps >= pretraining:
            raise InvalidValueError(
                f"{KEY}[{number}].{FROM} is {segment.from_env_steps}, but it must be below "
                f"agent.pretraining_env_steps = {pretraining}: only the pretraining has a schedule"
            )
        changing: Any = algorithm
        try:
            algorithm = dataclasses.replace(changing, **segment.values)
        except InvalidValueError as error:
            raise InvalidValueError(f"{KEY}[{number}]: {error}") from error
        algorithms.append((segment.from_env_steps, algorithm))
    return algorithms

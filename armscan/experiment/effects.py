"""Settings that have no effect: refused, or noted."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from gymnasium import spaces
from omegaconf import DictConfig

from armscan.agents import PlaneFinder
from armscan.agents.networks import is_vector
from armscan.errors import InvalidValueError
from armscan.experiment.agent import make_algorithm
from armscan.training.subject_splits import PHANTOMS

BY_OBSERVATION = "armscan.agents.NetworkByObservation"


def check_effects(config: DictConfig, overrides: Sequence[str]) -> None:
    """Check that a new run's settings have an effect.

    Plane finders take no memory, `plane_finder` has its own network, and `data=mixed` validates and tests on volumes of
    its folder, unless `phantoms` are given.

    Args:
        config: Configuration of the run.
        overrides: Its overrides.

    Raises:
        InvalidValueError: If a setting has no effect.
    """
    for part in ("validation", "test"):
        given = _given(rf"data\.n_{part}", overrides)
        if given and config.data.get(part, PHANTOMS) != PHANTOMS:
            raise InvalidValueError(
                f"{given!r} has no effect: the {part} volumes are those of data.path; give data.{part}={PHANTOMS}"
            )
    if not isinstance(algorithm := make_algorithm(config), PlaneFinder):
        return
    if config.env.memory:
        raise InvalidValueError(f"memory is {config.env.memory}, but a plane finder takes no best actions: give 0")
    if type(algorithm) is not PlaneFinder:
        return
    if given := _given("network", overrides):
        raise InvalidValueError(
            f"{given!r} has no effect: agent=plane_finder has a network of its own, with agent.filters and "
            "agent.hidden_sizes"
        )


def unused_network(config: DictConfig, space: spaces.Space[Any], overrides: Sequence[str]) -> str | None:
    """Return the first override of the network that the observation does not choose; None if there is none."""
    if config.network.get("_target_") != BY_OBSERVATION:
        return None
    return _given(rf"network\.{'images' if is_vector(space) else 'vector'}", overrides)


def _given(key: str, overrides: Sequence[str]) -> str | None:
    """Return the first override of a key, a regular expression, or of what is below it."""
    return next((each for each in overrides if re.match(rf"[+~]*{key}[=.]", each)), None)

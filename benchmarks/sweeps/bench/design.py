"""The configurations of a bench: the default one, then a Sobol sequence through the space of a sweep."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from optuna.distributions import BaseDistribution, CategoricalDistribution, IntDistribution
from scipy.stats import qmc

from armscan.config.compose import compose, reduce_to_run
from armscan.errors import InvalidValueError
from armscan.sweeps.space.parameter import Value, optuna_value
from armscan.sweeps.space.space import Space
from armscan.sweeps.tasks.attempt import config_sha256
from armscan.utils.arrays import FloatArray

# Seed of the Sobol sequence's scrambling.
SEED = 0


@dataclass(frozen=True)
class Design:
    """The configurations of a bench.

    Args:
        sweep: Name of the sweep.
        space: Search space of the sweep.
        configs: Values by name of each configuration, the default one first.
        fixed_sha256: First 12 digits of the SHA-256 of the default configuration.
    """

    sweep: str
    space: Space
    configs: tuple[dict[str, Value], ...]
    fixed_sha256: str

    @classmethod
    def of(cls, sweep: str, n_configs: int, overrides: Sequence[str] = ()) -> Design:
        """Return the first configurations of a sweep; a larger number only appends to them.

        Args:
            sweep: Name of the sweep, such as `sac_y`.
            n_configs: Number of configurations, at least 1.
            overrides: Overrides of the configuration, as on the command line. Default: none.
        """
        config = compose([f"sweep={sweep}", *overrides], return_hydra_config=True)
        space = Space.read(OmegaConf.to_container(config.study.space, resolve=True))
        if conditional := [each.name for each in space.parameters if each.when]:
            raise InvalidValueError(
                f"sweep {sweep} searches {conditional[0]} only beside other values, which no bench does"
            )
        fixed, _ = reduce_to_run(config)
        points = sobol(len(space.parameters), n_configs - 1)
        return cls(sweep, space, (default_of(space, fixed), *(values_at(space, row) for row in points)), _sha256(fixed))


def sobol(n_dimensions: int, n_points: int) -> FloatArray:
    """Return the first points of a scrambled Sobol sequence, shape (n_points, n_dimensions), from 0 to below 1."""
    sequence = qmc.Sobol(n_dimensions, rng=np.random.default_rng(SEED))
    return np.asarray(sequence.random_base2(max(1, n_points - 1).bit_length()))[:n_points]


def values_at(space: Space, places: FloatArray) -> dict[str, Value]:
    """Return the values of a space by name at a point, given by a place from 0 to below 1 in each dimension."""
    return {
        each.name: value_at(each.distribution, float(place))
        for each, place in zip(space.parameters, places, strict=True)
    }


def default_of(space: Space, config: DictConfig) -> dict[str, Value]:
    """Return the values that the keys of a space have in a configuration."""
    return {each.name: optuna_value(OmegaConf.select(config, each.name)) for each in space.parameters}


def presets_of(sweep: str, space: Space) -> tuple[dict[str, Value], ...]:
    """Return the values of the presets that the studies of a sweep try first, `study.enqueue`."""
    names = compose([f"sweep={sweep}"]).study.enqueue
    return tuple(default_of(space, compose([f"sweep={sweep}", f"experiment={name}"])) for name in names)


def value_at(distribution: BaseDistribution, place: float) -> Value:
    """Return the value of a distribution at a place, its quantile from 0 to below 1."""
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices[int(place * len(distribution.choices))]
    drawn: Any = distribution
    is_whole = isinstance(drawn, IntDistribution)
    low, high = (drawn.low - 0.5, drawn.high + 0.5) if is_whole else (drawn.low, drawn.high)
    number = math.exp(_between(math.log(low), math.log(high), place)) if drawn.log else _between(low, high, place)
    # Seven digits, as `write_rows` writes them: read again, they are the same.
    return min(max(round(number), drawn.low), drawn.high) if is_whole else float(f"{number:.7g}")


def places_of(space: Space, values: Mapping[str, Value]) -> list[float]:
    """Return where values by name lie in each dimension of a space; see `place_of`."""
    return [place_of(each.distribution, values[each.name]) for each in space.parameters]


def place_of(distribution: BaseDistribution, value: Any) -> float:
    """Return where a value lies in its range, from 0 to 1; for a choice, where it comes in the list of choices."""
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices.index(value) / max(1, len(distribution.choices) - 1)
    drawn: Any = distribution
    scale = math.log if drawn.log else float
    return float((scale(value) - scale(drawn.low)) / (scale(drawn.high) - scale(drawn.low)))


def _between(low: float, high: float, place: float) -> float:
    return low + (high - low) * place


def _sha256(config: DictConfig) -> str:
    values: Any = OmegaConf.to_container(config, resolve=True)
    # Where runs are tracked does not change a curve.
    return config_sha256({key: value for key, value in values.items() if key != "tracking"})[:12]

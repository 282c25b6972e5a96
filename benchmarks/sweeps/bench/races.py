"""Choosing among the best of a search: a race over seeds beside the same number of seeds for all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from armscan.stats.bootstrap import Estimate
from armscan.volumes.plane import FloatArray
from benchmarks.sweeps.bench.replay import Rule, choose, scores_of, search
from benchmarks.sweeps.bench.surrogate import SimulatedConfig, Surrogate

# Seeds of all candidates, and the fewest and most of a race; the first race is armscan's default.
FIXED = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24)
RACES = ((2, 6), (2, 16), (5, 10), (5, 16))
N_REPEATS, N_RESAMPLES = 10, 2000


class Choices(NamedTuple):
    """Choices of a rule, as means over repeated choices.

    Args:
        regret: Mean steps that the chosen candidate is truly worse than the best one, shape (studies,).
        n_trainings: Trainings of the choice, shape (studies,).
    """

    regret: FloatArray
    n_trainings: FloatArray


class Comparison(NamedTuple):
    """A race beside fixed seeds.

    Args:
        seeds: Fewest and most seeds of the race.
        regret: Its mean regret.
        n_trainings: Its mean number of trainings.
        n_fixed: Trainings that fixed seeds need for the same regret; infinite where none of `FIXED` reaches it.
        share: Share of those that the race needs.
    """

    seeds: tuple[int, int]
    regret: Estimate
    n_trainings: float
    n_fixed: float
    share: Estimate


def candidates_of(
    surrogate: Surrogate, sweep: str, rule: Rule, *, n_studies: int, n_trainings: int, top_k: int
) -> list[list[SimulatedConfig]]:
    """Return the best configurations of each of many simulated searches."""
    found = (search(surrogate, sweep, rule, n_trainings=n_trainings, seed=number) for number in range(n_studies))
    return [[each.config for each in of_study.candidates[:top_k]] for of_study in found]


def choices_of(
    candidates: Sequence[Sequence[SimulatedConfig]], seeds: Iterable[tuple[int, int]]
) -> dict[tuple[int, int], Choices]:
    """Return what races choose in each study, all of them of the same simulated trainings.

    Args:
        candidates: Configurations of each study.
        seeds: Fewest and most seeds of each race; where these are equal, nobody is dropped.
    """
    seeds = tuple(seeds)
    found = np.empty((len(seeds), 2, len(candidates), N_REPEATS))
    for number, of_study in enumerate(candidates):
        truths = [each.truth for each in of_study]
        for repeat in range(N_REPEATS):
            scores = scores_of(of_study, max(high for _, high in seeds), np.random.default_rng([number, repeat]))
            for place, (low, high) in enumerate(seeds):
                chosen = choose(scores, min_seeds=low, max_seeds=high)
                found[place, :, number, repeat] = truths[chosen.place] - min(truths), chosen.n_trainings
    return {each: Choices(*found[place].mean(axis=-1)) for place, each in enumerate(seeds)}


def compare(fixed: Sequence[Choices], races: dict[tuple[int, int], Choices]) -> list[Comparison]:
    """Return each race beside the fixed seeds that choose as well, with intervals that draw studies.

    Args:
        fixed: Choices with the numbers of seeds of `FIXED`, fewest first.
        races: Choices of each race, of the same studies.
    """
    n_studies = len(fixed[0].regret)
    drawn = np.random.default_rng(0).integers(n_studies, size=(N_RESAMPLES, n_studies))
    drawn = np.vstack([np.arange(n_studies), drawn])
    of_fixed = np.array([each.regret[drawn].mean(axis=1) for each in fixed]).T
    n_of_fixed = np.array([each.n_trainings.mean() for each in fixed])
    compared = []
    for seeds, race in races.items():
        regrets, n_trainings = race.regret[drawn].mean(axis=1), race.n_trainings[drawn].mean(axis=1)
        needed = np.array([needed_for(*pair, n_of_fixed) for pair in zip(regrets, of_fixed, strict=True)])
        share = n_trainings / needed
        compared.append(
            Comparison(seeds, _estimate(regrets), float(n_trainings[0]), float(needed[0]), _estimate(share))
        )
    return compared


def needed_for(regret: float, regrets: FloatArray, n_trainings: FloatArray) -> float:
    """Return the trainings at which a curve of regrets first falls to a regret, interpolated; infinite if it does not.

    Args:
        regret: The regret to reach.
        regrets: Regrets of the curve, made to fall only.
        n_trainings: Trainings of each of them, rising.
    """
    falling = np.minimum.accumulate(regrets)
    reached = falling <= regret
    if not reached.any():
        return float("inf")
    first = int(reached.argmax())
    if first == 0:
        return float(n_trainings[0])
    above, below = falling[first - 1], falling[first]
    return float(
        n_trainings[first] - (n_trainings[first] - n_trainings[first - 1]) * (regret - below) / (above - below)
    )


def _estimate(values: FloatArray) -> Estimate:
    """Return the first value, with the interval of the others, which are resamples."""
    low, high = np.quantile(values[1:], [0.025, 0.975], method="inverted_cdf")
    return Estimate(float(values[0]), float(low), float(high))

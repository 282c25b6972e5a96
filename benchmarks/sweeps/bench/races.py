"""Choosing among the best of a search: a race over seeds, compared with the same number of seeds for all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from armscan.stats.bootstrap import Estimate
from armscan.utils.arrays import FloatArray
from benchmarks.sweeps.bench.importance import estimate_of
from benchmarks.sweeps.bench.replay import Rule, scores_of, search
from benchmarks.sweeps.bench.seed_rules import (
    MAX_SEEDS,
    SeedRule,
    allocation,
    fixed,
    friedman_race,
    halving,
    is_ahead,
    t_race,
)
from benchmarks.sweeps.bench.surrogate import SELECTION_PART, SimulatedConfig, Surrogate

N_SEEDS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24, 32)
FIXED: Mapping[str, SeedRule] = {f"{n_seeds} seeds each": fixed(n_seeds) for n_seeds in N_SEEDS}
# Seeds of all configurations at first, and on average; the first pair is armscan's default.
ALLOCATIONS = ((2, 12), (2, 6), (2, 8), (2, 16), (3, 12))
# Fewest and most seeds, and the confidence at which a configuration is dropped.
T_RACES = ((3, 8, 0.9), (2, 6, 0.8), (5, 10, 0.9), (4, 16, 0.95))
RACES: Mapping[str, SeedRule] = {
    **{f"allocation, {low} seeds, then {mean} on average": allocation(low, mean) for low, mean in ALLOCATIONS},
    "allocation, 2 seeds, then 12 on average, one training at a time": allocation(2, 12, n_at_once=1),
    "allocation, 2 seeds, then 6 on average, never ends early": allocation(2, 6, ends=None),
    "allocation, 2 seeds, then 6 on average, ends by t tests": allocation(2, 6, ends=is_ahead),
    **{f"t test at {level:.0%}, {low} to {high} seeds": t_race(low, high, level) for low, high, level in T_RACES},
    **{f"Friedman's test, {low} to 16 seeds": friedman_race(low, 16) for low in (3, 5)},
    **{f"halving, from {low} seeds": halving(low) for low in (2, 3)},
}
N_REPEATS, N_RESAMPLES = 60, 2000


class Choices(NamedTuple):
    """Choices of a rule, as means over repeated choices.

    Args:
        regret: True mean steps of the chosen candidate above the best one's, shape (studies,). On the validation
            volumes, because no rule sees the test volumes.
        n_trainings: Trainings of the choice, shape (studies,).
    """

    regret: FloatArray
    n_trainings: FloatArray


class Comparison(NamedTuple):
    """A race compared with fixed seeds.

    Args:
        rule: Name of its rule.
        regret: Its mean regret.
        n_trainings: Its mean number of trainings.
        n_fixed: Trainings that fixed seeds need for the same regret; infinite where none of `FIXED` reaches it.
        most_fixed: Trainings of the last one of `FIXED`.
        share: Trainings of the race as a share of `n_fixed`. Where none of `FIXED` reaches its regret, an upper bound:
            the share of the last one's trainings.
    """

    rule: str
    regret: Estimate
    n_trainings: float
    n_fixed: float
    most_fixed: float
    share: Estimate


def candidates_of(
    surrogate: Surrogate, sweep: str, rule: Rule, *, n_studies: int, n_trainings: int, top_k: int
) -> list[list[SimulatedConfig]]:
    """Return the best configurations of each of many simulated searches."""
    found = (search(surrogate, sweep, rule, n_trainings=n_trainings, seed=number) for number in range(n_studies))
    return [[each.config for each in of_study.candidates[:top_k]] for of_study in found]


def choices_of(
    candidates: Sequence[Sequence[SimulatedConfig]],
    rules: Mapping[str, SeedRule],
    *,
    part: int = SELECTION_PART,
    truth: int = SELECTION_PART,
) -> dict[str, Choices]:
    """Return what rules choose in each study, all from the same simulated trainings.

    Args:
        candidates: Configurations of each study, the same number in each.
        rules: The rules by their names.
        part: Part of a simulated training that the rules see. Default: its selection.
        truth: Part whose mean is the true value of a configuration. Default: the selection.
    """
    truths = np.array([[each.truth_of(truth) for each in of_study] for of_study in candidates])
    regrets = np.repeat(truths - truths.min(axis=1, keepdims=True), N_REPEATS, axis=0)
    scores = np.array(
        [
            scores_of(of_study, MAX_SEEDS, np.random.default_rng([number, repeat]), part)
            for number, of_study in enumerate(candidates)
            for repeat in range(N_REPEATS)
        ]
    )
    found = {}
    for name, rule in rules.items():
        chosen = rule(scores)
        of_choices = np.take_along_axis(regrets, chosen.place[:, np.newaxis], axis=1)[:, 0], chosen.n_trainings
        found[name] = Choices(*(each.reshape(len(candidates), N_REPEATS).mean(axis=1) for each in of_choices))
    return found


def compare(fixed: Sequence[Choices], races: Mapping[str, Choices]) -> list[Comparison]:
    """Compare each race with the fixed seeds that choose as well, with bootstrap intervals over studies.

    Args:
        fixed: Choices of the rules of `FIXED`, fewest seeds first.
        races: Choices of each race, of the same studies.
    """
    n_studies = len(fixed[0].regret)
    drawn = np.random.default_rng(0).integers(n_studies, size=(N_RESAMPLES, n_studies))
    drawn = np.vstack([np.arange(n_studies), drawn])
    of_fixed = np.array([each.regret[drawn].mean(axis=1) for each in fixed]).T
    n_of_fixed = np.array([each.n_trainings.mean() for each in fixed])
    compared = []
    for rule, race in races.items():
        regrets, n_trainings = race.regret[drawn].mean(axis=1), race.n_trainings[drawn].mean(axis=1)
        needed = np.array([needed_for(*pair, n_of_fixed) for pair in zip(regrets, of_fixed, strict=True)])
        shares = n_trainings / needed.clip(max=n_of_fixed[-1])
        regret, share = (estimate_of(each, method="inverted_cdf") for each in (regrets, shares))
        compared.append(Comparison(rule, regret, float(n_trainings[0]), float(needed[0]), n_of_fixed[-1], share))
    return compared


def needed_for(regret: float, regrets: FloatArray, n_trainings: FloatArray) -> float:
    """Return the trainings at which a curve of regrets first falls to a regret, interpolated; infinite if it does not.

    Args:
        regret: The regret to reach.
        regrets: Regrets of the curve, of which the running minimum counts.
        n_trainings: Trainings of each regret, increasing.
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

"""Compute importances and effects of the keys of a space, with bootstrap intervals over configurations."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
import optuna
from optuna.importance import FanovaImportanceEvaluator, PedAnovaImportanceEvaluator, get_param_importances

from armscan.stats.bootstrap import Estimate
from armscan.utils.arrays import FloatArray
from benchmarks.sweeps.bench.design import places_of, sobol, values_at
from benchmarks.sweeps.bench.surrogate import Surrogate
from benchmarks.sweeps.bench.table import Curves

# Values of a key, and points of a Sobol sequence over which its effect is averaged, a power of 2.
N_VALUES, N_PLACES = 9, 32


class Key(NamedTuple):
    """Importance and effect of a key.

    Args:
        fanova: Share of the variance between configurations that fANOVA attributes to it.
        ped_anova: Share of the importance among the best configurations, by PED-ANOVA.
        effect: Mean steps at its worst value over those at its best, averaged over the other keys.
        places: Places of its values, shape (values,), from 0 to 1.
        steps: Mean steps at each value with their interval, shape (values, 3).
    """

    fanova: Estimate
    ped_anova: Estimate
    effect: Estimate
    places: FloatArray
    steps: FloatArray


def keys_of(curves: Curves, n_resamples: int) -> dict[str, Key]:
    """Return importance and effect of each key of a table.

    Args:
        curves: The table.
        n_resamples: Number of resamples of its configurations, for the intervals.
    """
    rng, n = np.random.default_rng(0), len(curves.configs)
    drawn = [np.arange(n), *(np.sort(rng.integers(n, size=n)) for _ in range(n_resamples))]
    tables = [curves.of(each) for each in drawn]
    importances = [_importances(each) for each in tables]
    effects = [effects_of(Surrogate.of(each)) for each in tables]
    found = {}
    for name in importances[0]:
        steps = np.array([of_resample[name][1] for of_resample in effects])
        found[name] = Key(
            estimate_of(np.array([each[name][0] for each in importances])),
            estimate_of(np.array([each[name][1] for each in importances])),
            estimate_of(steps.max(axis=1) / steps.min(axis=1)),
            effects[0][name][0],
            np.column_stack([steps[0], *np.quantile(steps[1:], [0.025, 0.975], axis=0)]),
        )
    return found


def effects_of(surrogate: Surrogate) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the places of values of each key, and the mean steps at each, averaged over the other keys."""
    space = surrogate.space
    points = sobol(len(space.parameters), N_PLACES)
    effects = {}
    for dimension, parameter in enumerate(space.parameters):
        choices = getattr(parameter.distribution, "choices", ())
        # The middle of each of equal parts of the range.
        drawn = (np.arange(len(choices) or N_VALUES) + 0.5) / (len(choices) or N_VALUES)
        steps, places = np.empty(len(drawn)), np.empty(len(drawn))
        for number, place in enumerate(drawn):
            varied = points.copy()
            varied[:, dimension] = place
            found = np.array([places_of(space, values_at(space, row)) for row in varied])
            # The geometric mean: an arithmetic one would be ruled by settings that fail.
            steps[number], places[number] = np.exp(np.log(surrogate.truth(found)).mean()), found[0, dimension]
        effects[parameter.name] = places, steps
    return effects


def _importances(curves: Curves) -> dict[str, tuple[float, float]]:
    """Return the shares by fANOVA and by PED-ANOVA of each key, of the logarithm of the test's mean steps."""
    study = optuna.create_study()
    distributions = {each.name: each.distribution for each in curves.space.parameters}
    for values, steps in zip(curves.configs, curves.mean_over_seeds(np.log(curves.test["mean_steps"])), strict=True):
        study.add_trial(optuna.create_trial(params=values, distributions=distributions, value=float(steps)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shares = [
            get_param_importances(study, evaluator=evaluator, params=list(distributions))
            for evaluator in (FanovaImportanceEvaluator(n_trees=32, seed=0), PedAnovaImportanceEvaluator())
        ]
    return {name: (shares[0][name], shares[1][name]) for name in distributions}


def estimate_of(values: FloatArray, *, method: str = "linear") -> Estimate:
    """Return the first value with the 95 % interval of the others, its resamples; `method` is that of NumPy."""
    return Estimate(float(values[0]), *map(float, np.nanquantile(values[1:], [0.025, 0.975], method=method)))

"""Many simulated studies for each sampler, pruner and rule of seeds, ranked by what they choose."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import joblib
import numpy as np
import pandas as pd

from armscan.stats.aggregation import band_over_seeds, probability_of_improvement
from armscan.utils.arrays import FloatArray
from benchmarks.sweeps.bench.design import presets_of
from benchmarks.sweeps.bench.replay import DEFAULT, Rule, choose, scores_of, search, silence
from benchmarks.sweeps.bench.seed_rules import MAX_SEEDS, fixed
from benchmarks.sweeps.bench.surrogate import SimulatedConfig, Surrogate

SAMPLERS, PRUNERS = ("random", "tpe", "cmaes", "nsga2"), ("none", "median", "percentile", "halving")
# Samplers that are also compared with two seeds a trial.
TWO_SEEDS = ("random", "tpe")
# The rule that all are compared with.
REFERENCE = Rule("random", "none")


class Final(NamedTuple):
    """Rule of a final evaluation.

    Args:
        min_seeds: Seeds that each configuration gets first.
        mean_seeds: Seeds of a configuration on average, at most. If they are `min_seeds`, the best mean is chosen.
        has_control: Whether the control races, too. Default: True.
        top_k: Number of the best trials that race. Default: 3.
    """

    min_seeds: int
    mean_seeds: int
    has_control: bool = True
    top_k: int = 3


# Rules are ranked without the control: chosen in place of bad candidates, it hides what a sampler finds.
FINALS = {
    "fixed": Final(5, 5, has_control=False),
    "race": Final(2, 12, has_control=False),
    "control": Final(2, 12),
    "eight": Final(2, 12, top_k=8),
}


def rules(samplers: Sequence[str] = SAMPLERS) -> Iterator[Rule]:
    """Yield the rules that are compared: each sampler with each pruner, two with two seeds, the default with presets.

    Args:
        samplers: Names of groups `study/sampler`. Default: all but `gp`, which takes a hundred times longer than others
            to propose a trial.
    """
    whole = itertools.starmap(Rule, itertools.product(samplers, PRUNERS))
    further = [Rule(each, "median", 2) for each in TWO_SEEDS] + [replace(DEFAULT, has_presets=True)]
    # Each rule once, the reference first.
    yield from dict.fromkeys([REFERENCE, *whole, *(rule for rule in further if rule.sampler in samplers)])


def studies_of(
    surrogate: Surrogate,
    control: SimulatedConfig,
    sweep: str,
    compared: Iterable[Rule],
    *,
    n_studies: int,
    n_trainings: int,
    workers: int = 1,
) -> pd.DataFrame:
    """Simulate studies, each with the same budget of environment steps in its search.

    Args:
        surrogate: Simulates the trainings.
        control: The default configuration.
        sweep: Name of the sweep.
        compared: Rules of the studies.
        n_studies: Studies of each rule.
        n_trainings: Budget of each search, in whole trainings.
        workers: Processes that simulate. Default: 1, this one.

    Returns:
        A row for each study: the true mean steps of its choice above the best of the space, chosen by the best value of
        the search and by each of `FINALS`, and the trainings of the latter.
    """
    _, best = surrogate.best()
    presets = presets_of(sweep, surrogate.space)

    def row_of(rule: Rule, number: int) -> dict[str, Any]:
        if workers > 1:
            silence()
        enqueued = presets if rule.has_presets else ()
        found = search(surrogate, sweep, rule, n_trainings=n_trainings, seed=number, enqueued=enqueued)
        tops = [candidate.config for candidate in found.candidates[: max(final.top_k for final in FINALS.values())]]
        row = {**vars(rule), "study": number, "n_trials": found.n_trials, "search": tops[0].truth - best}
        scores = scores_of([control, *tops], MAX_SEEDS, np.random.default_rng([number, 1]))
        for name, final in FINALS.items():
            # The control is first, so that it wins a tie, as in armscan.
            racing = [control, *tops][not final.has_control : 1 + final.top_k]
            of_racing = scores[not final.has_control : 1 + final.top_k]
            if final.mean_seeds == final.min_seeds:
                (place,), (n_raced,) = fixed(final.min_seeds)(of_racing[np.newaxis])
            else:
                place, n_raced = choose(of_racing, min_seeds=final.min_seeds, mean_seeds=final.mean_seeds)
            row |= {name: racing[place].truth - best, f"{name}_trainings": n_raced}
        return row

    studies = itertools.product(compared, range(n_studies))
    return pd.DataFrame(joblib.Parallel(n_jobs=workers)(joblib.delayed(row_of)(*each) for each in studies))


def ranked(studies: pd.DataFrame, by: str = "race") -> pd.DataFrame:
    """Return a row for each rule, the best first.

    Args:
        studies: Rows of `studies_of`.
        by: Column of the regret that they are ranked by. Default: `race`.

    Returns:
        The mean regret, and the probability that a study chooses better than one with random search and no pruning,
        each with its 95 % interval.
    """
    keys = list(vars(REFERENCE))
    columns = ["n_trials", "search", *FINALS, *(f"{name}_trainings" for name in FINALS)]
    regrets = {Rule(*key): each[by].to_numpy() for key, each in studies.groupby(keys)}
    rows = []
    for rule, each in regrets.items():
        of_rule = studies[(studies[keys] == pd.Series(vars(rule))).all(axis=1)]
        regret = band_over_seeds(each[:, np.newaxis])
        better = probability_of_improvement(-each[:, np.newaxis], -regrets[REFERENCE][:, np.newaxis])
        rows.append(
            {
                **vars(rule),
                "further": rule.further,
                **dict(zip(("regret", "low", "high"), (float(end[0]) for end in regret), strict=True)),
                **dict(zip(("better", "better_low", "better_high"), better, strict=True)),
                **{name: float(of_rule[name].mean()) for name in columns},
                "n_studies": len(each),
            }
        )
    return pd.DataFrame(rows).sort_values("regret", ignore_index=True)


def curve_of(regrets: Sequence[FloatArray]) -> FloatArray:
    """Return the mean regret of each column with its interval, shape (columns, 3)."""
    return np.array(band_over_seeds(np.column_stack(regrets))).T

"""Trials and trainings until studies that begin with known settings find the best ones of a study that does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import bootstrap

from armscan.config.compose import compose
from armscan.stats.bootstrap import Estimate
from armscan.sweeps.space.parameter import Value
from armscan.sweeps.space.space import Space
from armscan.sweeps.study.warm_start import first_different
from armscan.utils.arrays import FloatArray
from benchmarks.sweeps.bench.design import presets_of
from benchmarks.sweeps.bench.replay import DEFAULT, Rule, Search, search
from benchmarks.sweeps.bench.surrogate import Surrogate
from benchmarks.sweeps.bench.table import Curves

# Studies that begin with nothing, and those that begin with settings of another study, of presets, or of both.
COLD, BEGUN = ("cold", "independent"), ("warm", "preset", "preset, warm")
UNITS = ("trials", "trainings")


class SimulatedSweep(NamedTuple):
    """A sweep, and how its studies are simulated.

    Args:
        sweep: Name of the sweep.
        surrogate: Simulates its trainings.
        rule: Sampler, pruner and seeds of its trials.
        n_trials: Budget of each search, in whole trials.
    """

    sweep: str
    surrogate: Surrogate
    rule: Rule
    n_trials: int

    @classmethod
    def of(cls, sweep: str, pruner: str = DEFAULT.pruner) -> SimulatedSweep:
        """Return a sweep with the table of its trainings, and with its own number of seeds and trials.

        Args:
            sweep: Name of the sweep.
            pruner: Name of a group `study/pruner`. Default: `median`.
        """
        study = compose([f"sweep={sweep}"]).study
        rule = replace(DEFAULT, pruner=pruner, n_seeds=len(study.seeds))
        return cls(sweep, Surrogate.of(Curves.read(sweep)), rule, study.n_trials)


def replays(
    source: SimulatedSweep, target: SimulatedSweep, n_studies: int, cold: SimulatedSweep | None = None
) -> pd.DataFrame:
    """Simulate each study cold, with a warm start, with the presets of the sweep, with both, and independently.

    A warm start tries the best settings of a study of the source with the same seed first. The independent study is
    cold, too, with another seed: a cold study always finds its own best settings, which may be lucky, another one in
    only half of the cases. So the others are compared with both.

    Args:
        source: Sweep whose best settings are tried first.
        target: Sweep that is searched.
        n_studies: Number of studies of each kind.
        cold: The same sweep, as studies search it that begin with nothing. Default: `target`.

    Returns:
        A row for each study, with columns (`trials`, `trainings` or `reached`, one of `COLD` or of `BEGUN`): the number
        until the truly best settings of the cold study, or better ones, have run to their end, one more than all if
        they never do; and 1 if they do, else 0.
    """
    cold, presets = cold or target, presets_of(target.sweep, target.surrogate.space)
    rows = []
    for seed in range(n_studies):
        known = best_that_fit(_search(source, seed), target.surrogate.space)
        searches = {
            "cold": _search(cold, seed),
            "independent": _search(cold, n_studies + seed),
            "warm": _search(target, seed, known),
            "preset": _search(target, seed, presets),
            "preset, warm": _search(target, seed, (*presets, *known)),
        }
        goal = min(each.config.truth for each in searches["cold"].candidates)
        rows.append(pd.DataFrame({kind: _until(found, goal) for kind, found in searches.items()}).stack())
    return pd.DataFrame(rows)


def best_that_fit(found: Search, space: Space) -> tuple[dict[str, Value], ...]:
    """Return the different settings of the best trials, with the nearest values of a space, as a warm start does."""
    fits = (space.fit(each.values, nearest=True) for each in found.candidates)
    return first_different(chosen for chosen, misfit in fits if chosen and misfit is None)


def share_of(begun: pd.Series, cold: pd.Series) -> Estimate:
    """Return the median of begun studies over that of cold ones, with a 95 % bootstrap interval over studies.

    Args:
        begun: Trials or trainings of each study that begins with known settings.
        cold: Trials or trainings of each study that does not, in the same order.
    """

    def share(begun: FloatArray, cold: FloatArray, axis: int = -1) -> FloatArray:
        return np.asarray(np.median(begun, axis=axis) / np.median(cold, axis=axis))

    samples = begun.to_numpy(), cold.to_numpy()
    drawn = bootstrap(samples, share, paired=True, method="percentile", rng=np.random.default_rng(0))
    return Estimate(float(share(*samples)), *map(float, drawn.confidence_interval))


def _search(target: SimulatedSweep, seed: int, enqueued: Sequence[Mapping[str, Value]] = ()) -> Search:
    sweep, surrogate, rule, n_trials = target
    return search(surrogate, sweep, rule, n_trainings=n_trials * rule.n_seeds, seed=seed, enqueued=enqueued)


def _until(found: Search, goal: float) -> dict[str, float]:
    reached = [each for each in found.candidates if each.config.truth <= goal]
    first = min(reached, key=lambda each: each.number, default=None)
    if first is None:
        return {"trials": found.n_trials + 1.0, "trainings": found.n_trainings + 1.0, "reached": 0.0}
    return {"trials": first.number + 1.0, "trainings": first.n_trainings, "reached": 1.0}

"""Episodes of an evaluation: their part of the noise between seeds, and what more of them are worth to a race."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from armscan.errors import InvalidValueError
from armscan.stats.bootstrap import Estimate
from armscan.utils.arrays import FloatArray
from benchmarks.sweeps.bench.collect import commit, run_jobs, train_and_evaluate
from benchmarks.sweeps.bench.importance import estimate_of
from benchmarks.sweeps.bench.power import GOOD
from benchmarks.sweeps.bench.races import FIXED, N_RESAMPLES, RACES, Choices, Comparison, choices_of, compare
from benchmarks.sweeps.bench.replay import DEFAULT, search
from benchmarks.sweeps.bench.surrogate import Surrogate, centred
from benchmarks.sweeps.bench.table import FOLDER, MIN_SEEDS, SELECTION, Curves, write_sorted

# Blocks of an evaluation with as many episodes as the tables' have; all of them together are as many as in a study.
N_BLOCKS, N_EPISODES = 5, 200
COLUMNS = tuple(f"mean_steps_{block}" for block in range(N_BLOCKS))
# armscan's own race.
RACE = next(iter(RACES))


def episodes_file(sweep: str) -> Path:
    """Return where the evaluations of a sweep's configurations are."""
    return FOLDER / f"{sweep}_episodes.csv.gz"


def collect_evaluations(
    sweep: str, n_seeds: int, workers: int = 1, *, overrides: Sequence[str] = (), file: Path | None = None
) -> None:
    """Train what is missing of the good configurations of a table, and evaluate each training in many episodes.

    A good configuration takes at most twice the mean steps of the best.

    Args:
        sweep: Name of the sweep, such as `sac_y`.
        n_seeds: Trainings of each configuration, with the seeds from 0.
        workers: Processes that train. Default: 1, this one.
        overrides: Overrides of all trainings, as on the command line. Default: none.
        file: File of the evaluations. Default: None, the one of the bench.
    """
    file, curves = file or episodes_file(sweep), Curves.read(sweep)
    truths = np.exp(curves.mean_over_seeds(np.log(curves.test["mean_steps"])))
    good = [number for number in truths.argsort() if truths[number] <= GOOD * truths.min()]
    rows = pd.read_csv(file) if file.exists() else pd.DataFrame(columns=["commit", "config", "seed", *COLUMNS])
    done = set(zip(rows.config, rows.seed, strict=True))
    missing = [(number, seed) for seed in range(n_seeds) for number in good if (number, seed) not in done]
    print(f"{sweep}: {len(done)} trainings are in {file.name}, {len(missing)} are missing", flush=True)
    words = [f"sweep={sweep}", *overrides, f"evaluation.episodes={N_BLOCKS * N_EPISODES}"]
    origin, write = {"commit": commit()}, partial(write_sorted, file, by=["config", "seed"])
    jobs = [
        joblib.delayed(_evaluated)(words, curves.configs[number], {**origin, "config": number, "seed": seed})
        for number, seed in missing
    ]
    run_jobs(jobs, rows, write, workers)


def _evaluated(words: Sequence[str], values: dict[str, Any], row: dict[str, Any]) -> list[dict[str, Any]]:
    _, evaluations = train_and_evaluate(words, values, row["seed"])
    n_steps = np.array([each.n_steps for each in evaluations[SELECTION].episodes])
    return [row | dict(zip(COLUMNS, n_steps.reshape(N_BLOCKS, -1).mean(axis=1), strict=True))]


@dataclass(frozen=True)
class Evaluations:
    """The evaluations of trainings of good configurations.

    Args:
        curves: Table of the sweep.
        numbers: Numbers of the configurations in the table.
        logs: Logarithm of the mean steps of each training in each block of its episodes, and in all of them, shape
            (trainings, blocks + 1).
        config_of: Place of each training's configuration in `numbers`, shape (trainings,).
    """

    curves: Curves
    numbers: NDArray[np.intp]
    logs: FloatArray
    config_of: NDArray[np.intp]

    @classmethod
    def read(cls, sweep: str, file: Path | None = None) -> Evaluations:
        """Return the evaluations of the configurations with at least three seeds."""
        file = file or episodes_file(sweep)
        if not file.exists():
            raise InvalidValueError(
                f"there are no evaluations of {sweep} yet: python -m benchmarks.sweeps.bench collect-episodes {sweep}"
            )
        rows = pd.read_csv(file).groupby("config").filter(lambda of_config: len(of_config) >= MIN_SEEDS)
        numbers, config_of = np.unique(rows.config, return_inverse=True)
        blocks = rows[[*COLUMNS]].to_numpy(float)
        return cls(Curves.read(sweep), numbers, np.log(np.column_stack([blocks, blocks.mean(axis=1)])), config_of)

    def noise(self) -> FloatArray:
        """Return the variance between seeds in a block of episodes, and in all, of each configuration; the best first.

        Its shape is (configurations, 2).
        """
        means, residuals = centred(self.logs, self.config_of)
        squares = np.array([(residuals[self.config_of == each] ** 2).mean(axis=0) for each in range(len(self.numbers))])
        of_each = np.column_stack([squares[:, :-1].mean(axis=1), squares[:, -1]])
        return np.asarray(of_each[means[:, -1].argsort()])

    def surrogate(self) -> Surrogate:
        """Return a surrogate whose trainings have the mean steps in each block of episodes, and in all."""
        means, residuals = centred(self.logs, self.config_of)
        return replace(
            Surrogate.of(self.curves.of(self.numbers)),
            # A block is easier or harder for all trainings: that would not change which one is chosen.
            means=np.repeat(means[:, -1:], means.shape[1], axis=1),
            residuals=residuals,
            config_of=self.config_of,
            bounds=(float(self.logs.min()), float(self.logs.max())),
        )


def share_of_noise(noise: FloatArray) -> Estimate:
    """Return the variance between seeds in all episodes as a share of that in a block, with an interval.

    Args:
        noise: Rows of `Evaluations.noise`, which the interval resamples.
    """
    drawn = np.random.default_rng(0).integers(len(noise), size=(N_RESAMPLES, len(noise)))
    of_block, of_all = np.vstack([noise.mean(axis=0), noise[drawn].mean(axis=1)]).T
    return estimate_of(of_all / of_block)


def races(evaluated: Evaluations, *, n_studies: int, n_trainings: int, top_k: int) -> dict[str, Comparison]:
    """Compare armscan's race with fixed seeds, both by a block of episodes or by all of them.

    Args:
        evaluated: The evaluations.
        n_studies: Simulated studies.
        n_trainings: Budget of the search of each, in whole trainings.
        top_k: Candidates of a race, beside the control.
    """
    simulated, curves = evaluated.surrogate(), evaluated.curves
    searched, candidates = Surrogate.of(curves), []
    for number in range(n_studies):
        found = search(searched, curves.sweep, DEFAULT, n_trainings=n_trainings, seed=number).candidates[:top_k]
        raced = [curves.configs[0], *(each.values for each in found)]
        candidates.append([simulated.config(values) for values in raced])

    def chosen(parts: Iterable[int]) -> tuple[list[Choices], dict[str, Choices]]:
        """Return what fixed seeds, and the race, choose by one of these parts, on average over the parts."""
        rules = {**FIXED, RACE: RACES[RACE]}
        of_parts = [choices_of(candidates, rules, part=part, truth=-1) for part in parts]
        means = {name: Choices(*np.mean([of_part[name] for of_part in of_parts], axis=0)) for name in rules}
        return [means[name] for name in FIXED], {RACE: means[RACE]}

    by_blocks, by_all = chosen(range(N_BLOCKS)), chosen([-1])
    few, many = f"{N_EPISODES}", f"{N_BLOCKS * N_EPISODES:,}"
    pairs = {(few, few): (by_blocks, by_blocks), (many, few): (by_all, by_blocks), (many, many): (by_all, by_all)}
    return {
        f"the race with {mine} episodes, fixed seeds with {theirs}": compare(fixed, race)[0]
        for (mine, theirs), ((_, race), (fixed, _)) in pairs.items()
    }

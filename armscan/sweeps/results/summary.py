"""The result of a study: its best configurations on the test volumes, over seeds that did not choose them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState

from armscan.stats.aggregation import mean_for, over_seeds
from armscan.stats.bootstrap import Estimate
from armscan.sweeps.scheduling.state import FINALIST, METRICS

OF_VOLUME = re.compile(r"test/volume/(.+)/(\w+)")
SHOWN = ("test/success_rate", "test/mean_steps", "test/mean_distance_mm", "test/mean_distance_deg")


@dataclass(frozen=True)
class ConfigResult:
    """Final evaluation of one configuration.

    Args:
        number: of the trial that found it.
        n_seeds: number of final trainings.
        means: by metric: its mean over the seeds, with its interval.
    """

    number: int
    n_seeds: int
    means: Mapping[str, Estimate]

    def text(self, name: str) -> str:
        """Return a metric with its interval, such as `1.52 (1.4 to 1.7)`."""
        mean, low, high = (f"{round(number, 3):g}" for number in self.means[name])
        return mean if low == "nan" else f"{mean} ({low} to {high})"


def values_of(trial: FrozenTrial, objectives: Iterable[str]) -> str:
    """Return the values of a trial with the names of the objectives, as a text."""
    return ", ".join(f"{name} {value:.4g}" for name, value in zip(objectives, trial.values, strict=True))


def shown_of(result: ConfigResult) -> list[str]:
    """Return the names of the metrics that a table shows: the most telling, or all if it has none of these."""
    return [name for name in SHOWN if name in result.means] or list(result.means)


def final_results(trials: Sequence[FrozenTrial], *, seed: int = 0) -> list[ConfigResult]:
    """Return the final evaluation of each configuration.

    The interquartile mean over seeds and test volumes (of success rates the mean, where every failure counts), with an
    interval by a bootstrap of the seeds: Agarwal et al. 2021 (arXiv:2108.13264), but that each seed is drawn with all
    its volumes, because one training was evaluated on all of them.

    Args:
        trials: of the final evaluation; unfinished ones are left out.
        seed: of the resamples; the same trials and seed give the same intervals.
    """
    of_number: dict[int, list[dict[str, float]]] = {}
    for trial in trials:
        if trial.state == TrialState.COMPLETE:
            of_number.setdefault(int(trial.user_attrs[FINALIST]), []).append(trial.user_attrs[METRICS])
    return [_config_result(number, of_seeds, seed) for number, of_seeds in of_number.items()]


def _config_result(number: int, of_seeds: Sequence[Mapping[str, float]], seed: int) -> ConfigResult:
    common = set.intersection(*map(set, of_seeds))
    of_seeds = [{name: value for name, value in metrics.items() if name in common} for metrics in of_seeds]
    names = [name for name in of_seeds[0] if name.startswith("test/") and not OF_VOLUME.fullmatch(name)]
    means = {name: over_seeds(_scores(name, of_seeds), mean_for(name), seed=seed) for name in names}
    return ConfigResult(number, len(of_seeds), means)


def _scores(name: str, of_seeds: Sequence[Mapping[str, float]]) -> NDArray[np.float64]:
    """Return a metric of shape (seeds, test volumes), or (seeds, 1) if it is not known for each volume."""
    metric = name.removeprefix("test/")
    volumes = [key for key in of_seeds[0] if (found := OF_VOLUME.fullmatch(key)) and found[2] == metric]
    return np.array([[metrics[key] for key in volumes or [name]] for metrics in of_seeds])

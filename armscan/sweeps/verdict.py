"""The result of a study: its best configurations on the test volumes, over seeds that did not choose them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState

from armscan.sweeps.tally import FIGURES, JUDGED

N_RESAMPLES = 2000
OF_VOLUME = re.compile(r"test/volume/(.+)/(\w+)")
SHOWN = ("test/success_rate", "test/mean_steps", "test/mean_distance_mm", "test/mean_distance_deg")


@dataclass(frozen=True)
class Verdict:
    """One configuration, judged.

    Args:
        number: of the trial that it was found by.
        n_seeds: trainings that it was judged by.
        means: by figure: its mean over the seeds, lower and upper end of the mean's 95 % interval.
    """

    number: int
    n_seeds: int
    means: Mapping[str, tuple[float, float, float]]

    def text(self, name: str) -> str:
        """Returns a figure with its interval, such as `1.52 (1.4 to 1.7)`."""
        mean, low, high = (f"{round(number, 3):g}" for number in self.means[name])
        return mean if low == "nan" else f"{mean} ({low} to {high})"


def shown_of(verdict: Verdict) -> list[str]:
    """Returns the names of the figures that a table shows: the most telling, or all where none of these is there."""
    return [name for name in SHOWN if name in verdict.means] or list(verdict.means)


def verdicts(judged: Sequence[FrozenTrial], *, seed: int = 0) -> list[Verdict]:
    """Returns what the trainings that judge say of each configuration.

    The interquartile mean over seeds and test volumes (of success rates the mean, where every failure counts), with an
    interval by stratified bootstrap of the seeds, as Agarwal et al. 2021 (arXiv:2108.13264) recommend.

    Args:
        judged: trials of the study that judges; those that have not finished are left out.
        seed: of the resamples: the same trials give the same intervals.
    """
    of_number: dict[int, list[dict[str, float]]] = {}
    for trial in judged:
        if trial.state == TrialState.COMPLETE:
            of_number.setdefault(int(trial.user_attrs[JUDGED]), []).append(trial.user_attrs[FIGURES])
    return [_verdict(number, of_seeds, seed) for number, of_seeds in of_number.items()]


def _verdict(number: int, of_seeds: Sequence[Mapping[str, float]], seed: int) -> Verdict:
    common = set.intersection(*map(set, of_seeds))
    of_seeds = [{name: figure for name, figure in figures.items() if name in common} for figures in of_seeds]
    names = [name for name in of_seeds[0] if name.startswith("test/") and not OF_VOLUME.fullmatch(name)]
    return Verdict(number, len(of_seeds), {name: _interval(name, _scores(name, of_seeds), seed) for name in names})


def _scores(name: str, of_seeds: Sequence[Mapping[str, float]]) -> NDArray[np.float64]:
    """Returns a figure of shape (seeds, test volumes), or (seeds, 1) where it is not known of each volume."""
    figure = name.removeprefix("test/")
    volumes = [key for key in of_seeds[0] if (found := OF_VOLUME.fullmatch(key)) and found[2] == figure]
    return np.array([[figures[key] for key in volumes or [name]] for figures in of_seeds])


def _interval(name: str, scores: NDArray[np.float64], seed: int) -> tuple[float, float, float]:
    # Deferred: it takes a second, and only who judges needs it.
    from rliable import library, metrics

    mean = metrics.aggregate_mean if "success_rate" in name else metrics.aggregate_iqm
    if len(scores) < 2 or np.isnan(scores).any():
        return float(mean(scores)), float("nan"), float("nan")
    with _numpy_seeded(seed):
        points, ends = library.get_interval_estimates(
            {"it": scores}, lambda each: np.array([mean(each)]), reps=N_RESAMPLES
        )
    return float(points["it"][0]), float(ends["it"][0, 0]), float(ends["it"][1, 0])


@contextmanager
def _numpy_seeded(seed: int) -> Iterator[None]:
    """Seeds NumPy's global generator, and gives it back as it was.

    rliable's bootstrap draws from that one, whatever `random_state` it is given (seen in 1.2.0).
    """
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002

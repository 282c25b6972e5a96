"""The result of a study: its best configurations on the test volumes, over seeds that did not choose them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState

from armscan.sweeps.tally import FIGURES, JUDGED
from armscan.training.bootstrap import Estimate
from armscan.training.seeds import mean_for, over_seeds

OF_VOLUME = re.compile(r"test/volume/(.+)/(\w+)")
SHOWN = ("test/success_rate", "test/mean_steps", "test/mean_distance_mm", "test/mean_distance_deg")


@dataclass(frozen=True)
class Verdict:
    """One configuration, judged.

    Args:
        number: of the trial that it was found by.
        n_seeds: trainings that it was judged by.
        means: by figure: its mean over the seeds, with its interval.
    """

    number: int
    n_seeds: int
    means: Mapping[str, Estimate]

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
    interval by a bootstrap of the seeds: Agarwal et al. 2021 (arXiv:2108.13264), but that each seed is drawn with all
    its volumes, because one training was judged on all of them.

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
    means = {name: over_seeds(_scores(name, of_seeds), mean_for(name), seed=seed) for name in names}
    return Verdict(number, len(of_seeds), means)


def _scores(name: str, of_seeds: Sequence[Mapping[str, float]]) -> NDArray[np.float64]:
    """Returns a figure of shape (seeds, test volumes), or (seeds, 1) where it is not known of each volume."""
    figure = name.removeprefix("test/")
    volumes = [key for key in of_seeds[0] if (found := OF_VOLUME.fullmatch(key)) and found[2] == figure]
    return np.array([[figures[key] for key in volumes or [name]] for figures in of_seeds])

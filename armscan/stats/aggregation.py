"""Aggregate trainings with several seeds: bands of curves, and how likely one group is better than another.

Agarwal et al. 2021 (arXiv:2108.13264) recommend both figures, with intervals that bootstrap the seeds. With fewer than
ten seeds these are too narrow, so the intervals here are Student's and Newcombe's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armscan.errors import InvalidValueError
from armscan.stats.bootstrap import UPPER, Estimate
from armscan.stats.paired import crossed_mean
from armscan.utils.arrays import FloatArray

# With fewer seeds a band would be wider than a chart.
MIN_SEEDS = 3
# Steps of a bisection from 0 to 1, to the last bit.
N_HALVINGS = 53


class Band(NamedTuple):
    """A figure at several points with its interval at each, shape (points,); the ends are NaN if there is none."""

    values: FloatArray
    lows: FloatArray
    highs: FloatArray


def band_over_seeds(scores: FloatArray) -> Band:
    """Return the mean over the seeds at each point, with Student's 95 % interval for other seeds.

    Args:
        scores: Scores, shape (seeds, points), all finite.

    Returns:
        The band, without an interval if there are fewer than `MIN_SEEDS` seeds.
    """
    means, halves = crossed_mean(scores.T[..., np.newaxis])
    if len(scores) < MIN_SEEDS:
        halves = np.full_like(means, np.nan)
    return Band(means, means - halves, means + halves)


def probability_of_improvement(ours: FloatArray, theirs: FloatArray) -> Estimate:
    """Return how likely a training of ours is better than one of theirs on the same volume, averaged over the volumes.

    The share of pairs of seeds in which ours is greater, where ties count half: the Mann-Whitney statistic. The
    interval holds every probability from which the estimate is no further than chance explains, given the variance that
    the statistic has at that probability: method 5 of Newcombe 2006, doi:10.1002/sim.2324. It is wide enough for few
    seeds, and wide for two, because the mean over several volumes varies less than this variance.

    Args:
        ours: Our scores, shape (seeds, volumes), greater is better, all finite.
        theirs: Their scores, shape (seeds, the same volumes).

    Returns:
        The estimate, without an interval if either has one seed.

    Raises:
        InvalidValueError: If the numbers of volumes differ.
    """
    return probabilities_of_improvement([(ours, theirs)])[0]


def probabilities_of_improvement(pairs: Sequence[tuple[FloatArray, FloatArray]]) -> list[Estimate]:
    """Return `probability_of_improvement` of each pair, for many pairs at once."""
    wins = [_wins(*pair) for pair in pairs]
    values = np.array([each.mean() for each in wins])
    n_seeds = np.array([each.shape for each in wins], dtype=float).reshape(-1, 2)
    ends = [np.where(n_seeds.min(axis=1) < 2, np.nan, _furthest(values, end, n_seeds)) for end in (0.0, 1.0)]
    return [Estimate(*map(float, each)) for each in zip(values, *ends, strict=True)]


def _furthest(values: FloatArray, end: float, n_seeds: FloatArray) -> FloatArray:
    """Return the probability closest to `end` that explains each estimate; `n_seeds` has shape (estimates, 2)."""
    from scipy.special import ndtri

    inside, outside = values, np.full_like(values, end)
    for _ in range(N_HALVINGS):
        each = (inside + outside) / 2
        excess = (n_seeds.sum(axis=1) / 2 - 1) * ((1 - each) / (2 - each) + each / (1 + each))
        variance = each * (1 - each) * (1 + excess) / n_seeds.prod(axis=1)
        explains = (values - each) ** 2 <= ndtri(UPPER) ** 2 * variance
        inside, outside = np.where(explains, each, inside), np.where(explains, outside, each)
    return inside


def _wins(ours: FloatArray, theirs: FloatArray) -> FloatArray:
    """Return how often ours is better over the volumes, shape (our seeds, their seeds); a tie is half a win."""
    if ours.shape[1:] != theirs.shape[1:]:
        raise InvalidValueError(
            f"scores are of {ours.shape[1]} and of {theirs.shape[1]} volumes, but they must be of the same ones"
        )
    pairs = ours[:, None], theirs[None, :]
    return np.asarray((np.greater(*pairs) + 0.5 * np.equal(*pairs)).mean(axis=-1))

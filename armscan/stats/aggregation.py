"""Aggregate trainings with several seeds, as Agarwal et al. 2021 (arXiv:2108.13264) recommend.

Intervals are percentile bootstraps of the seeds, with generators of their own: the same numbers give the same interval.
With two or three seeds such an interval is just the range from the lowest to the highest; with four or more it is an
interval, though somewhat too narrow for few.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armscan.errors import InvalidValueError
from armscan.stats.bootstrap import LEVEL, MOST_VALUES, N_RESAMPLES, Estimate
from armscan.volumes.plane import FloatArray

# What is cut from each end of the sorted values in an interquartile mean.
QUARTER = 0.25
# With fewer seeds an interval is no more than their range.
FEWEST_SEEDS = 4
# Steps of a bisection from 0 to 1, to the last digit of a number.
N_HALVINGS = 53
# Quantiles at the ends of an interval.
ENDS = (1 - LEVEL) / 2, (1 + LEVEL) / 2

Mean = Callable[..., Any]


class Band(NamedTuple):
    """A figure at several points with its interval at each, shape (points,); the ends are NaN if there is none."""

    values: FloatArray
    lows: FloatArray
    highs: FloatArray


def interquartile_mean(values: ArrayLike, axis: int | None = None) -> Any:
    """Return the mean without the lowest and the highest quarter, by default of all values; of fewer than four all."""
    from scipy.stats import trim_mean

    return trim_mean(values, QUARTER, axis=axis)


def over_seeds(scores: FloatArray, mean: Mean, *, seed: int = 0) -> Estimate:
    """Return the mean over seeds and volumes, with an interval that draws seeds, each with all its volumes.

    Args:
        scores: Scores, shape (seeds, volumes).
        mean: Function that aggregates the values, such as `numpy.mean`.
        seed: Seed of the resamples. Default: 0.

    Returns:
        The estimate, without an interval if there is one seed or a score is NaN.
    """
    value = float(mean(scores))
    if len(scores) < 2 or np.isnan(scores).any():
        return Estimate(value, np.nan, np.nan)
    low, high = _ends((np.arange(len(scores)),), lambda drawn: mean(scores[drawn]), seed=seed, vectorized=False)
    return Estimate(value, float(low), float(high))


def band_over_seeds(scores: FloatArray) -> Band:
    """Return the mean over the seeds at each point, with an interval; a resample has the same seeds at all points.

    Args:
        scores: Scores, shape (seeds, points), all finite.

    Returns:
        The band, without an interval if there is one seed.
    """
    values = scores.mean(axis=0)
    if len(scores) < 2 or not scores.size:
        return Band(values, *(np.full(len(values), np.nan) for _ in range(2)))
    drawn = _times_drawn(len(scores), np.random.default_rng(0)) @ scores / len(scores)
    return Band(values, *np.quantile(drawn, ENDS, axis=0))


def probability_of_improvement(ours: FloatArray, theirs: FloatArray) -> Estimate:
    """Return how likely a training of ours is better than one of theirs on the same volume, averaged over the volumes.

    The share of pairs of seeds in which ours is greater, where ties count half: the statistic of Mann and Whitney. The
    interval draws each seed with all its volumes, because one training was judged on all of them.

    Args:
        ours: Our scores, shape (seeds, volumes), greater is better, all finite.
        theirs: Their scores, shape (seeds, the same volumes).

    Returns:
        The estimate, without an interval where either has one seed.

    Raises:
        InvalidValueError: If the volumes are not as many.
    """
    return probabilities_of_improvement([(ours, theirs)])[0]


def probabilities_of_improvement(pairs: Sequence[tuple[FloatArray, FloatArray]]) -> list[Estimate]:
    """Return `probability_of_improvement` of each pair, for many pairs at once."""
    estimates: dict[int, Estimate] = {}
    of_shape: dict[tuple[int, ...], list[tuple[int, FloatArray]]] = defaultdict(list)
    for number, pair in enumerate(pairs):
        wins = _wins(*pair)
        estimates[number] = Estimate(float(wins.mean()), np.nan, np.nan)
        of_shape[wins.shape].append((number, wins))
    for (n_ours, n_theirs), of_pairs in of_shape.items():
        if min(n_ours, n_theirs) < 2:
            continue
        rng = np.random.default_rng(0)
        ours, theirs = _times_drawn(n_ours, rng), _times_drawn(n_theirs, rng)
        at_once = max(1, MOST_VALUES // ours.size)
        for first in range(0, len(of_pairs), at_once):
            numbers, wins_of = zip(*of_pairs[first : first + at_once], strict=True)
            drawn = ((theirs @ np.swapaxes(wins_of, 1, 2)) * ours).sum(axis=-1) / (n_ours * n_theirs)
            for number, low, high in zip(numbers, *np.quantile(drawn, ENDS, axis=-1), strict=True):
                estimates[number] = estimates[number]._replace(low=float(low), high=float(high))
    return [estimates[number] for number in range(len(pairs))]


def improvement_of_few_seeds(ours: FloatArray, theirs: FloatArray) -> Estimate:
    """Return `probability_of_improvement` with an interval that is wide enough for few seeds, and wide for two.

    The interval holds the probabilities from which the estimate is no further than chance explains, with the variance
    that the statistic of Mann and Whitney would have there: method 5 of Newcombe 2006, doi:10.1002/sim.2324. The mean
    over several volumes varies less than that.
    """
    value = float(_wins(ours, theirs).mean())
    if min(len(ours), len(theirs)) < 2:
        return Estimate(value, np.nan, np.nan)
    return Estimate(value, *(_furthest(value, end, len(ours), len(theirs)) for end in (0.0, 1.0)))


def _furthest(value: float, end: float, n_ours: int, n_theirs: int) -> float:
    """Return the probability closest to `end` that explains an estimate."""
    from scipy.special import ndtri

    inside, outside = value, end
    for _ in range(N_HALVINGS):
        each = (inside + outside) / 2
        excess = ((n_ours + n_theirs) / 2 - 1) * ((1 - each) / (2 - each) + each / (1 + each))
        variance = each * (1 - each) * (1 + excess) / (n_ours * n_theirs)
        explains = (value - each) ** 2 <= ndtri(ENDS[1]) ** 2 * variance
        inside, outside = (each, outside) if explains else (inside, each)
    return inside


def _wins(ours: FloatArray, theirs: FloatArray) -> FloatArray:
    """Return how often a seed of ours is better, by volume, shape (our seeds, their seeds); a tie is half a win."""
    if ours.shape[1:] != theirs.shape[1:]:
        raise InvalidValueError(
            f"scores are of {ours.shape[1]} and of {theirs.shape[1]} volumes, but they must be of the same ones"
        )
    pairs = ours[:, None], theirs[None, :]
    return np.asarray((np.greater(*pairs) + 0.5 * np.equal(*pairs)).mean(axis=-1))


def _times_drawn(n_seeds: int, rng: np.random.Generator) -> FloatArray:
    """Return how often each seed is drawn in each resample, shape (resamples, seeds)."""
    drawn = rng.integers(n_seeds, size=(N_RESAMPLES, n_seeds))
    return np.asarray((drawn[..., None] == np.arange(n_seeds)).sum(axis=1), dtype=float)


def _ends(samples: tuple[NDArray[Any], ...], statistic: Mean, *, seed: int = 0, **how: Any) -> tuple[Any, Any]:
    from scipy.stats import bootstrap

    how |= {"n_resamples": N_RESAMPLES, "confidence_level": LEVEL, "method": "percentile"}
    interval = bootstrap(samples, statistic, rng=np.random.default_rng(seed), **how).confidence_interval
    return interval.low, interval.high

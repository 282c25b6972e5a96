"""Race of configurations over seeds: which trainings come next, and which configuration is chosen.

All configurations first get a few seeds. Further seeds go, in rounds, to the configurations where they most increase
the probability of a correct selection: the optimal computing budget allocation (OCBA) of Chen et al. (2000,
doi:10.1023/A:1008349927281). Everything here is a function of the scores alone, so workers that see the same storage
decide the same, and an interrupted race continues where it was.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from armscan.stats.bootstrap import UNKNOWN, UPPER, Estimate
from armscan.utils.arrays import FloatArray

# For an early end of the race: the largest expected loss from choosing the leader instead of another configuration, in
# standard deviations of a score, and the seeds that the leader must have, because with fewer it may be lucky.
END_LOSS, LEADER_SEEDS = 0.05, 5
# Maximum number of seeds of a configuration, as a multiple of `mean_seeds`.
MAX_SEEDS_FACTOR = 4
# Prior degrees of freedom: the weight of the pooled variance in each configuration's variance, which two or three seeds
# estimate poorly.
PRIOR_DF = 4.0
# Minimum gap between two means, relative to the largest mean and absolute, because gaps are divisors. So are variances,
# to which the square of the gap is added.
MIN_RELATIVE_GAP, MIN_GAP = 1e-6, 1e-100

Scores = Mapping[int, Mapping[int, float]]
Counts = NDArray[np.intp]


@dataclass(frozen=True)
class Standing:
    """Standing of a configuration in a race.

    Args:
        estimate: Mean score with its 95 % interval; NaN before the first round is complete.
        n_seeds: Number of seeds that the estimate is over.
        has_failed: Whether one of its trainings has failed. Default: False.
        is_withdrawn: Whether it was withdrawn, because it violates a constraint. Default: False.
    """

    estimate: Estimate = UNKNOWN
    n_seeds: int = 0
    has_failed: bool = False
    is_withdrawn: bool = False

    @property
    def lower_end(self) -> float:
        """Lower end of the interval; the score itself if one seed gives no interval."""
        return self.estimate.value if math.isnan(self.estimate.low) else self.estimate.low


@dataclass(frozen=True)
class Race:
    """State of a race.

    Args:
        n_trained: Number of trainings that have ended, failed ones included, without those of withdrawn configurations.
        missing: Trainings of this round that have not ended, as pairs of a configuration and a seed. Empty if the race
            is over.
        chosen: Configuration that was chosen; None while the race continues, or if all configurations have failed in
            the first round.
        standings: Standing of each configuration.
    """

    n_trained: int
    missing: tuple[tuple[int, int], ...]
    chosen: int | None
    standings: Mapping[int, Standing] = field(default_factory=dict)

    @property
    def is_over(self) -> bool:
        """Whether no training is missing."""
        return not self.missing

    @property
    def leader(self) -> int | None:
        """Configuration with the best mean; None before the first round is complete, or if all have failed."""
        standings = self.standings
        remaining = [
            each for each, of_it in standings.items() if of_it.n_seeds and not (of_it.has_failed or of_it.is_withdrawn)
        ]
        return max(remaining, key=lambda each: standings[each].estimate.value, default=None)


def race(scores: Scores, seeds: Sequence[int], *, min_seeds: int, mean_seeds: int) -> Race:
    """Return the state of a race.

    All configurations are trained with the first `min_seeds` seeds. Each further round has one training for every three
    configurations that remain, at least two, where they most increase the probability of a correct selection. The
    race is over when the configurations have `mean_seeds` seeds on average, when the expected loss from choosing the
    leader is small (see `is_decided`), or when one configuration remains. The one whose interval has the highest lower
    end is chosen; the first of equal ones.

    Args:
        scores: Score of each finished training by configuration and seed, the higher the better. NaN for a failed
            training, which drops its configuration at the end of the round. A configuration without any score is a key
            too.
        seeds: All seeds of the race, in the order in which they are used: at least `min_seeds`, and as many as one
            configuration may get.
        min_seeds: Number of seeds that all configurations get, 1 or more.
        mean_seeds: Maximum number of seeds per configuration on average, `min_seeds` or more.
    """
    remaining, standings = list(scores), {configuration: Standing() for configuration in scores}
    n_seeds, most = dict.fromkeys(scores, min_seeds), mean_seeds * len(scores)
    while True:
        due = [(each, seed) for n, seed in enumerate(seeds) for each in remaining if n < n_seeds[each]]
        if missing := tuple((each, seed) for each, seed in due if seed not in scores[each]):
            # Decide nothing before the round is complete: the trainings must not depend on which of them ends first.
            return Race(sum(n_seeds.values()) - len(missing), missing, None, standings)
        rows = {each: [scores[each][seed] for seed in seeds[: n_seeds[each]]] for each in remaining}
        whole = [each for each in remaining if not any(map(math.isnan, rows[each]))]
        if not whole:
            # All have failed in this round: choose by the round before, or choose none if this is the first.
            remaining = [each for each in remaining if standings[each].n_seeds]
            standings |= {each: replace(standings[each], has_failed=True) for each in standings}
            break
        standings |= {each: replace(standings[each], has_failed=True) for each in remaining if each not in whole}
        remaining, counts = whole, np.array([n_seeds[each] for each in whole])
        of_remaining = np.array(list(zip_longest(*(rows[each] for each in remaining), fillvalue=0.0))).T
        means, variances = moments(of_remaining, counts)
        standings |= zip(remaining, _standings(means, variances, counts), strict=True)
        n_more = min(round_size(len(remaining)), most - sum(n_seeds.values()), int((len(seeds) - counts).sum()))
        if n_more <= 0 or len(remaining) == 1 or is_decided(means, variances, counts):
            break
        n_seeds |= zip(remaining, allocate(means, variances, counts, n_more, most=len(seeds)).tolist(), strict=True)
    chosen = max(remaining, key=lambda each: standings[each].lower_end, default=None)
    return Race(sum(n_seeds.values()), (), chosen, standings)


def budget(n_configurations: int, *, min_seeds: int, mean_seeds: int) -> tuple[int, int]:
    """Return a lower and an upper bound on the number of trainings of a race in which none fails.

    Args:
        n_configurations: Number of candidates, and the control.
        min_seeds: Seeds of each at first.
        mean_seeds: Seeds of each on average, at most.
    """
    if n_configurations == 1:
        return min_seeds, min_seeds
    least, most, size = n_configurations * min_seeds, n_configurations * mean_seeds, round_size(n_configurations)
    return min(most, least + math.ceil(max(0, LEADER_SEEDS - min_seeds) / size) * size), most


def round_size(n_configurations: int) -> int:
    """Return the number of trainings of a round after the first: few, because each round uses all earlier scores."""
    return max(2, n_configurations // 3)


def moments(scores: FloatArray, n_seeds: Counts) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of the scores of each configuration, shape (..., configurations).

    Args:
        scores: Scores, shape (..., configurations, seeds).
        n_seeds: Number of seeds of each configuration, whose scores come first, shape (..., configurations), 1 or more.
    """
    counts = np.arange(scores.shape[-1]) < n_seeds[..., np.newaxis]
    means = np.where(counts, scores, 0.0).sum(axis=-1) / n_seeds
    squares = np.where(counts, (scores - means[..., np.newaxis]) ** 2, 0.0).sum(axis=-1)
    # One seed does not give a variance.
    own, is_known = squares / np.maximum(n_seeds - 1, 1), n_seeds > 1
    pooled = own.sum(axis=-1, keepdims=True) / np.maximum(is_known.sum(axis=-1, keepdims=True), 1)
    return means, moderated_variances(own, pooled, n_seeds)


def moderated_variances(own: FloatArray, pooled: Any, n_seeds: Any) -> FloatArray:
    """Return the variances of scores, shrunk as in the moderated t statistics of Smyth 2004.

    See doi:10.2202/1544-6115.1027.

    Args:
        own: Variance of each configuration over its seeds.
        pooled: Mean of these variances.
        n_seeds: Number of seeds that each variance is over.
    """
    return np.asarray((PRIOR_DF * pooled + (n_seeds - 1) * own) / (PRIOR_DF + n_seeds - 1))


def half_widths(variances: FloatArray, n_seeds: Any) -> FloatArray:
    """Return the half-widths of the 95 % intervals of means: Student's t intervals with shrunk variances.

    Args:
        variances: Variance of the scores of each configuration.
        n_seeds: Number of seeds of each.
    """
    return np.asarray(stdtrit(PRIOR_DF + n_seeds - 1, UPPER) * np.sqrt(variances / n_seeds))


def is_decided(means: FloatArray, variances: FloatArray, n_seeds: Counts) -> NDArray[np.bool_]:
    """Return whether the leader has enough seeds, and the expected loss from choosing it is small, shape (...).

    The expected loss, or expected opportunity cost, is the mean of max(0, d), where d is another configuration's true
    score minus the leader's, assumed to be normally distributed. For each other configuration, it must be at most
    `END_LOSS` standard deviations of a score (Branke, Chick and Schmidt 2007, doi:10.1287/mnsc.1070.0721).

    Args:
        means: Mean score of each configuration, shape (..., configurations).
        variances: Variance of the scores of each, likewise.
        n_seeds: Seeds of each, likewise.
    """
    leader = means.argmax(axis=-1)[..., np.newaxis]
    mean, of_mean, n_leader = (np.take_along_axis(each, leader, -1) for each in (means, variances / n_seeds, n_seeds))
    spread = np.sqrt(of_mean + variances / n_seeds)
    ahead = (mean - means) / np.maximum(spread, MIN_GAP)
    losses = spread * (np.exp(-(ahead**2) / 2) / math.sqrt(2 * math.pi) - ahead * ndtr(-ahead))
    is_small = losses <= END_LOSS * np.sqrt(variances.mean(axis=-1, keepdims=True))
    is_leader = np.arange(means.shape[-1]) == leader
    return np.asarray((n_leader[..., 0] >= LEADER_SEEDS) & (is_small | is_leader).all(axis=-1))


def allocate(means: FloatArray, variances: FloatArray, n_seeds: Counts, n_more: int, *, most: int) -> Counts:
    """Return the number of seeds of each configuration once more are allocated, shape (..., configurations).

    Args:
        means: Mean score of each configuration, shape (..., configurations), two or more.
        variances: Variance of the scores of each, likewise.
        n_seeds: Seeds of each, likewise.
        n_more: Number of seeds to allocate, no more than `most` allows.
        most: Maximum number of seeds of a configuration.
    """
    places, leader = np.arange(means.shape[-1]), means.argmax(axis=-1)[..., np.newaxis]
    least_gap = np.maximum(MIN_RELATIVE_GAP * np.abs(means).max(axis=-1, keepdims=True), MIN_GAP)
    variances = variances + least_gap**2
    gaps = np.maximum(np.take_along_axis(means, leader, -1) - means, least_gap)
    shares = np.where(places == leader, 0.0, variances / gaps**2)
    of_leader = np.take_along_axis(variances, leader, -1) * (shares**2 / variances).sum(axis=-1, keepdims=True)
    shares = np.where(places == leader, np.sqrt(of_leader), shares)
    shares /= shares.sum(axis=-1, keepdims=True)
    for _ in range(n_more):
        due = shares * (n_seeds.sum(axis=-1, keepdims=True) + 1) - n_seeds
        n_seeds = n_seeds + (places == np.where(n_seeds < most, due, -np.inf).argmax(axis=-1)[..., np.newaxis])
    return n_seeds


def _standings(means: FloatArray, variances: FloatArray, n_seeds: Counts) -> Iterator[Standing]:
    """Yield the standings after a round."""
    half = half_widths(variances, n_seeds)
    # With one seed each, the variance is unknown.
    half = half if n_seeds.max() > 1 else np.full_like(half, math.nan)
    for mean, width, n in zip(means.tolist(), half.tolist(), n_seeds.tolist(), strict=True):
        yield Standing(Estimate.around(mean, width), n)

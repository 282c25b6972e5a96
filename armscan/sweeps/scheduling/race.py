"""Race of configurations over seeds: which trainings come next, and which configuration is chosen.

A few seeds first, for all; then one seed more at a time, for those that may still be the best, as irace
(López-Ibáñez et al. 2016) and SMAC's intensification do. Everything here is a function of the scores alone: workers
that see the same storage decide the same, and a race that was interrupted continues where it was.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import stdtrit

from armscan.stats.bootstrap import LEVEL, Estimate
from armscan.utils.arrays import FloatArray

# Confidence, one-sided, at which a configuration that is behind the leader is dropped.
DROP_LEVEL = 0.9
# Prior degrees of freedom: the weight of the pooled variance in that of each configuration, of which two or three seeds
# say little.
PRIOR_DF = 4.0

UNKNOWN = Estimate(math.nan, math.nan, math.nan)

Scores = Mapping[int, Mapping[int, float]]


@dataclass(frozen=True)
class Standing:
    """Standing of a configuration in a race.

    Args:
        estimate: Mean score with its 95 % interval; NaN before the first round is complete.
        n_seeds: Number of seeds that the estimate is over.
        is_in: Whether it can still be the best.
    """

    estimate: Estimate = UNKNOWN
    n_seeds: int = 0
    is_in: bool = True

    @property
    def lower_end(self) -> float:
        """Lower end of the interval; the score itself if one seed gives no interval."""
        return self.estimate.value if math.isnan(self.estimate.low) else self.estimate.low


@dataclass(frozen=True)
class Race:
    """A race as it stands.

    Args:
        missing: Trainings of this round without a score, the running ones included, as pairs of a configuration and a
            seed. Empty if the race is over.
        chosen: Configuration that was chosen; None while the race continues, or if all configurations have failed in
            the first round.
        standings: Standing of each configuration.
    """

    missing: tuple[tuple[int, int], ...]
    chosen: int | None
    standings: Mapping[int, Standing] = field(default_factory=dict)

    @property
    def is_over(self) -> bool:
        """Return whether no training is missing."""
        return not self.missing


def race(scores: Scores, seeds: Sequence[int], *, min_seeds: int, drop_level: float = DROP_LEVEL) -> Race:
    """Return the state of a race.

    All configurations are trained with the first `min_seeds` seeds. Then those are dropped whose mean is below the
    leader's by more than chance explains (a one-sided t test), and the others are trained with the next seed, until one
    is left or the seeds are used up. Of those that are left, the one with the highest lower end of its interval is
    chosen; the first of equal ones.

    Args:
        scores: Score of each finished training by configuration and seed, the higher the better. NaN for a failed
            training, which drops its configuration at the end of the round. A configuration without any score is a key
            too.
        seeds: All seeds of the race, in the order in which they are used.
        min_seeds: Number of seeds that all configurations get, from 1 to the number of seeds.
        drop_level: Confidence at which a configuration is dropped, from 0.5 to below 1. Default: 0.9.
    """
    left, standings = list(scores), {configuration: Standing() for configuration in scores}
    for n_seeds in range(min_seeds, len(seeds) + 1):
        now = seeds[:n_seeds]
        if missing := [(each, seed) for seed in now for each in left if seed not in scores[each]]:
            return Race(tuple(missing), None, standings)
        rows = {each: [scores[each][seed] for seed in now] for each in left}
        # Not before the round is complete: what is run must not depend on which training ends first.
        whole = [each for each in left if not np.isnan(rows[each]).any()]
        standings |= {each: replace(standings[each], is_in=False) for each in left if each not in whole}
        if not whole:
            # Of the round before, which had no failure; none in the first.
            left = left if n_seeds > min_seeds else []
            break
        standings |= _standings(whole, np.array([rows[each] for each in whole]), drop_level)
        left = [each for each in whole if standings[each].is_in]
        if len(left) == 1:
            break
    chosen = max(left, key=lambda each: standings[each].lower_end, default=None)
    return Race((), chosen, standings)


def budget(n_configurations: int, *, min_seeds: int, max_seeds: int) -> tuple[int, int]:
    """Return the fewest and the most trainings of a race in which none fails."""
    return n_configurations * min_seeds, n_configurations * max_seeds


def moderated_variances(own: FloatArray, pooled: Any, n_seeds: Any) -> FloatArray:
    """Return the variances of scores, shrunk as in the moderated t statistics of Smyth 2004.

    See doi:10.2202/1544-6115.1027.

    Args:
        own: Variance of each configuration over its seeds.
        pooled: Mean of these variances.
        n_seeds: Number of seeds that each variance is over.
    """
    return np.asarray((PRIOR_DF * pooled + (n_seeds - 1) * own) / (PRIOR_DF + n_seeds - 1))


def _standings(
    configurations: Sequence[int], scores: np.ndarray[tuple[int, int], np.dtype[np.float64]], drop_level: float
) -> Iterator[tuple[int, Standing]]:
    """Yield the standings after a round; `scores` has shape (configurations, seeds)."""
    n_seeds = scores.shape[1]
    means, variances = scores.mean(axis=1), np.zeros(len(scores))
    df = PRIOR_DF + n_seeds - 1
    if n_seeds > 1:
        own = scores.var(axis=1, ddof=1)
        variances = moderated_variances(own, own.mean(), n_seeds) / n_seeds
    leader = int(means.argmax())
    half = stdtrit(df, (1 + LEVEL) / 2) * np.sqrt(variances)
    allowed = stdtrit(df, drop_level) * np.sqrt(variances[leader] + variances)
    behind = means[leader] - means
    for number, configuration in enumerate(configurations):
        mean, width = float(means[number]), float(half[number]) if n_seeds > 1 else math.nan
        # With one seed nothing is known of chance.
        is_in = n_seeds == 1 or bool(behind[number] <= allowed[number])
        yield configuration, Standing(Estimate(mean, mean - width, mean + width), n_seeds, is_in)

"""Intervals of rates of independent trials, and of the difference of two, by Wilson and Newcombe."""

from __future__ import annotations

import math
from functools import cache
from statistics import NormalDist

from armscan.stats.bootstrap import UNKNOWN, UPPER, Estimate


@cache
def wilson(n_successes: int, n_trials: int) -> Estimate:
    """Return a rate with Wilson's interval, as if all trials were independent (Newcombe 1998, method 3)."""
    if n_trials == 0:
        return UNKNOWN
    # Not from scipy.stats, whose import takes a second.
    z = NormalDist().inv_cdf(UPPER)
    rate, whole = n_successes / n_trials, 2 * (n_trials + z**2)
    middle = (2 * n_successes + z**2) / whole
    delta = z / whole * math.sqrt(4 * n_successes * (1 - rate) + z**2)
    return Estimate(
        rate,
        middle - delta if n_successes else 0.0,
        middle + delta if n_successes < n_trials else 1.0,
    )


def difference_of_rates(ours: Estimate, theirs: Estimate) -> Estimate:
    """Return the difference of two independent rates, with an interval computed from theirs (Newcombe 1998).

    The interval is method 10 of doi:10.1002/(SICI)1097-0258(19980430)17:8<873::AID-SIM779>3.0.CO;2-I if theirs are
    Wilson's.
    """
    value = ours.value - theirs.value
    below = math.hypot(ours.value - ours.low, theirs.high - theirs.value)
    above = math.hypot(ours.high - ours.value, theirs.value - theirs.low)
    return Estimate(value, value - below, value + above)

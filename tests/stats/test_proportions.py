"""Intervals of rates, compared with SciPy's and with published ones."""

import math

import pytest
from scipy import stats

from armscan.stats.proportions import difference_of_rates, wilson


def test_wilson_is_that_of_scipy_and_has_a_width_at_the_ends():
    for n_successes in (0, 13, 200):
        theirs = stats.binomtest(n_successes, 200).proportion_ci(method="wilson")
        assert wilson(n_successes, 200)[1:] == pytest.approx((theirs.low, theirs.high))
    assert wilson(200, 200).low == pytest.approx(0.9812, abs=1e-4)
    assert all(map(math.isnan, wilson(0, 0)))


def test_difference_of_rates_is_the_published_one():
    # Newcombe (1998), 56 of 70 and 48 of 80.
    found = difference_of_rates(wilson(56, 70), wilson(48, 80))
    assert found == pytest.approx((0.2, 0.0524, 0.3339), abs=1e-4)

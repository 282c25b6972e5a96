"""Aggregation over seeds: against rliable, and properties for any scores."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rliable.metrics import probability_of_improvement as theirs
from scipy.stats import norm, t

from armscan.errors import InvalidValueError
from armscan.stats.aggregation import (
    band_over_seeds,
    probabilities_of_improvement,
    probability_of_improvement,
)


def scores(n_seeds, n_volumes):
    # Few values, so that there are ties.
    return arrays(float, (n_seeds, n_volumes), elements=st.sampled_from([-2.0, 0.0, 0.5, 1.0, 3.0]))


@st.composite
def two_groups(draw):
    n_volumes = draw(st.integers(1, 4))
    return tuple(draw(scores(draw(st.integers(2, 5)), n_volumes)) for _ in range(2))


@given(two_groups())
@settings(max_examples=40)
def test_probability_of_improvement_is_that_of_rliable_and_its_interval_is_mirrored(groups):
    ours, others = groups
    estimate, opposite = probability_of_improvement(ours, others), probability_of_improvement(others, ours)
    assert estimate.value == pytest.approx(theirs(ours, others))
    assert 0.0 <= estimate.low <= estimate.value <= estimate.high <= 1.0
    assert [estimate.low, estimate.high] == pytest.approx([1.0 - opposite.high, 1.0 - opposite.low])
    surely = probability_of_improvement(ours + 9.0, others)
    assert surely.value == surely.high == 1.0
    assert surely.low < 1.0


@given(two_groups())
@settings(max_examples=40)
def test_interval_of_improvement_solves_the_published_equation(groups):
    estimate = probability_of_improvement(*groups)
    n_ours, n_others = map(len, groups)
    for end in estimate[1:]:
        # Newcombe 2006, method 5: the exponential model's variance of the statistic, with the mean of both sizes.
        size = (n_ours + n_others) / 2
        terms = (
            end * (1 - end),
            (size - 1) * (1 - end) ** 2 * end / (2 - end),
            (size - 1) * end**2 * (1 - end) / (1 + end),
        )
        variance = sum(terms) / (n_ours * n_others)
        assert (estimate.value - end) ** 2 == pytest.approx(norm.ppf(0.975) ** 2 * variance, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("n_seeds", [2, 3, 5, 10])
@pytest.mark.parametrize("difference", [0.0, 1.0, 2.0])
def test_interval_of_improvement_holds_the_truth_in_more_than_92_percent_of_studies(n_seeds, difference):
    rng, n_studies = np.random.default_rng(0), 400
    # An effect of each training on all of eight volumes, and a residual.
    ours, others = (
        rng.standard_normal((n_studies, n_seeds, 1)) + 0.5 * rng.standard_normal((n_studies, n_seeds, 8))
        for _ in range(2)
    )
    truth = norm.cdf(difference / np.sqrt(2 * 1.25))
    found = [probability_of_improvement(*each) for each in zip(ours + difference, others, strict=True)]
    assert np.mean([each.low <= truth <= each.high for each in found]) > 0.92


@given(arrays(float, st.tuples(st.integers(3, 7), st.integers(1, 5)), elements=st.floats(-10, 10, width=32)))
@settings(max_examples=40)
def test_band_is_the_interval_of_student_at_each_point(values):
    band = band_over_seeds(values)
    spread = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    low, high = t.interval(0.95, len(values) - 1, loc=values.mean(axis=0), scale=np.maximum(spread, 1e-300))
    np.testing.assert_allclose(band.values, values.mean(axis=0))
    np.testing.assert_allclose(band.lows, low, atol=1e-9)
    np.testing.assert_allclose(band.highs, high, atol=1e-9)


def test_fewer_than_three_seeds_have_no_band():
    assert np.isnan(band_over_seeds(np.array([[1.0, 2.0], [3.0, 4.0]]))[1:]).all()


@given(st.lists(two_groups(), min_size=2, max_size=5))
@settings(max_examples=20)
def test_many_improvements_at_once_are_those_of_each_pair_alone(pairs):
    together = probabilities_of_improvement(pairs)
    assert together == [probability_of_improvement(*pair) for pair in pairs]


def test_one_seed_has_no_interval():
    one = np.array([[1.0, 2.0]])
    assert np.isnan(probability_of_improvement(one, one)[1:]).all()


def test_scores_of_other_numbers_of_volumes_are_refused():
    with pytest.raises(InvalidValueError, match="scores are of 2 and of 3 volumes"):
        probability_of_improvement(np.zeros((3, 2)), np.zeros((3, 3)))

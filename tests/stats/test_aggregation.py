"""Aggregation over seeds: against rliable, and properties for any scores."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rliable.library import get_interval_estimates
from rliable.metrics import probability_of_improvement as theirs
from scipy.stats import norm

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


@pytest.mark.parametrize("n_seeds", [2, 3, 5, 10])
@pytest.mark.parametrize("difference", [0.0, 1.0, 2.0])
def test_interval_of_improvement_holds_the_truth_in_more_than_92_percent_of_studies(n_seeds, difference):
    rng, n_studies = np.random.default_rng(0), 400
    # With an effect of each training on all of eight volumes, and a rest.
    ours, others = (
        rng.standard_normal((n_studies, n_seeds, 1)) + 0.5 * rng.standard_normal((n_studies, n_seeds, 8))
        for _ in range(2)
    )
    truth = norm.cdf(difference / np.sqrt(2 * 1.25))
    found = [probability_of_improvement(*each) for each in zip(ours + difference, others, strict=True)]
    assert np.mean([each.low <= truth <= each.high for each in found]) > 0.92


def stratified(scores, statistic, reps):
    """Return the interval of rliable."""
    _, ends = get_interval_estimates({"it": scores}, lambda *drawn: np.array([statistic(*drawn)]), reps=reps)
    return ends["it"][:, 0]


def test_band_is_the_interval_of_rliable_over_seeds_at_each_point():
    values = np.random.default_rng(0).gamma(2.0, 2.0, (20, 3))
    band = band_over_seeds(values)
    for place in range(values.shape[1]):
        expected = stratified(values[:, [place]], np.mean, reps=10_000)
        assert [band.lows[place], band.highs[place]] == pytest.approx(expected, rel=0.05)


@given(arrays(float, st.tuples(st.integers(2, 7), st.integers(1, 5)), elements=st.floats(-10, 10, width=32)))
@settings(max_examples=40)
def test_band_lies_within_the_seeds_and_is_the_same_each_time(values):
    band = band_over_seeds(values)
    assert np.allclose(band.values, values.mean(axis=0))
    slack = 1e-9
    assert (values.min(axis=0) - slack <= band.lows).all()
    assert (band.lows <= band.highs + slack).all()
    assert (band.highs <= values.max(axis=0) + slack).all()
    assert all(map(np.array_equal, band, band_over_seeds(values)))


@pytest.mark.parametrize("n_seeds", [2, 3])
def test_band_of_two_or_three_seeds_is_their_range(n_seeds):
    values = np.random.default_rng(0).normal(size=(n_seeds, 4))
    band = band_over_seeds(values)
    assert np.allclose(band.lows, values.min(axis=0))
    assert np.allclose(band.highs, values.max(axis=0))


@given(st.lists(two_groups(), min_size=2, max_size=5))
@settings(max_examples=20)
def test_many_improvements_at_once_are_those_of_each_pair_alone(pairs):
    together = probabilities_of_improvement(pairs)
    assert together == [probability_of_improvement(*pair) for pair in pairs]


def test_one_seed_has_no_interval():
    one = np.array([[1.0, 2.0]])
    assert np.isnan(band_over_seeds(one).lows).all()
    assert np.isnan(probability_of_improvement(one, one)[1:]).all()


def test_scores_of_other_numbers_of_volumes_are_refused():
    with pytest.raises(InvalidValueError, match="scores are of 2 and of 3 volumes"):
        probability_of_improvement(np.zeros((3, 2)), np.zeros((3, 3)))

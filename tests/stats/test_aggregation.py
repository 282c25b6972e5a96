"""Aggregation over seeds: against rliable, and properties for any scores."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rliable.library import get_interval_estimates
from rliable.metrics import aggregate_iqm
from rliable.metrics import probability_of_improvement as theirs
from scipy.stats import norm

from armscan.errors import InvalidValueError
from armscan.stats.aggregation import (
    band_over_seeds,
    improvement_of_few_seeds,
    interquartile_mean,
    over_seeds,
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
def test_probability_of_improvement_is_that_of_rliable(groups):
    ours, others = groups
    estimate = probability_of_improvement(ours, others)
    assert estimate.value == pytest.approx(theirs(ours, others))
    assert 0.0 <= estimate.low <= estimate.high <= 1.0
    opposite = probability_of_improvement(others, ours)
    assert opposite.value == pytest.approx(1.0 - estimate.value)
    assert probability_of_improvement(ours + 9.0, others) == (1.0, 1.0, 1.0)
    assert probability_of_improvement(ours, others) == estimate


@given(two_groups())
@settings(max_examples=40)
def test_interval_for_few_seeds_holds_the_estimate_and_is_mirrored(groups):
    ours, others = groups
    estimate, opposite = improvement_of_few_seeds(ours, others), improvement_of_few_seeds(others, ours)
    assert estimate.value == probability_of_improvement(ours, others).value
    assert 0.0 <= estimate.low <= estimate.value <= estimate.high <= 1.0
    assert [estimate.low, estimate.high] == pytest.approx([1.0 - opposite.high, 1.0 - opposite.low])


@pytest.mark.parametrize("n_seeds", [2, 3, 5, 10])
@pytest.mark.parametrize("difference", [0.0, 1.0, 2.0])
def test_interval_for_few_seeds_holds_the_truth_in_more_than_92_percent_of_studies(n_seeds, difference):
    rng, n_studies = np.random.default_rng(0), 400
    # With an effect of each training on all of eight volumes, and a rest.
    ours, others = (
        rng.standard_normal((n_studies, n_seeds, 1)) + 0.5 * rng.standard_normal((n_studies, n_seeds, 8))
        for _ in range(2)
    )
    truth = norm.cdf(difference / np.sqrt(2 * 1.25))
    found = [improvement_of_few_seeds(*each) for each in zip(ours + difference, others, strict=True)]
    assert np.mean([each.low <= truth <= each.high for each in found]) > 0.92


def stratified(scores, statistic, reps=300):
    """Return the interval of rliable, which draws the seeds of each volume by itself."""
    _, ends = get_interval_estimates({"it": scores}, lambda *drawn: np.array([statistic(*drawn)]), reps=reps)
    return ends["it"][:, 0]


def test_intervals_of_improvement_are_those_of_rliable_on_one_volume():
    rng = np.random.default_rng(0)
    ours, others = rng.normal(0.7, size=(8, 1)), rng.normal(size=(6, 1))
    # But for what is left to chance.
    expected = stratified((ours, others), theirs, reps=1500)
    assert probability_of_improvement(ours, others)[1:] == pytest.approx(expected, abs=0.05)


@pytest.mark.full
def test_interval_of_improvement_holds_the_truth_only_if_seeds_are_drawn_with_all_their_volumes():
    rng = np.random.default_rng(0)
    n_whole = n_stratified = 0
    for _ in range(60):
        # Each training is good or bad on all of eight volumes; both groups are the same.
        ours, others = (rng.normal(size=(10, 1)) + 0.3 * rng.normal(size=(10, 8)) for _ in range(2))
        whole, (low, high) = probability_of_improvement(ours, others), stratified((ours, others), theirs)
        n_whole += whole.low <= 0.5 <= whole.high
        n_stratified += low <= 0.5 <= high
    assert n_whole >= 50
    assert n_stratified <= 45


@pytest.mark.parametrize(("mean", "n_volumes"), [(interquartile_mean, 1), (np.mean, 1), (np.mean, 8)])
def test_intervals_over_seeds_are_those_of_rliable(mean, n_volumes):
    values = np.random.default_rng(0).gamma(2.0, 2.0, (5, n_volumes))
    # A seed that is drawn with all its volumes is a seed of one volume, that of their mean.
    of_seeds = values.mean(axis=1, keepdims=True)
    expected = stratified(of_seeds, aggregate_iqm if mean is interquartile_mean else np.mean, reps=10_000)
    assert over_seeds(values, mean)[1:] == pytest.approx(expected, rel=0.05)


def test_interval_over_seeds_holds_the_truth_only_if_they_are_drawn_with_all_their_volumes():
    rng = np.random.default_rng(0)
    n_whole = n_stratified = 0
    for _ in range(40):
        # Each training is good or bad on all of eight volumes; the mean of all trainings is 0.
        values = rng.normal(size=(8, 1)) + 0.3 * rng.normal(size=(8, 8))
        whole, (low, high) = over_seeds(values, np.mean), stratified(values, np.mean)
        n_whole += whole.low <= 0 <= whole.high
        n_stratified += low <= 0 <= high
    assert n_whole >= 32
    assert n_stratified <= 26


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


def test_band_is_the_interval_over_seeds_at_each_point():
    values = np.random.default_rng(0).gamma(2.0, 2.0, (6, 3))
    band = band_over_seeds(values)
    for place in range(values.shape[1]):
        found = [each[place] for each in band]
        assert found == pytest.approx(over_seeds(values[:, [place]], np.mean))


@given(st.lists(two_groups(), min_size=2, max_size=5))
@settings(max_examples=20)
def test_many_improvements_at_once_are_those_of_each_pair_alone(pairs):
    together = probabilities_of_improvement(pairs)
    assert together == [probability_of_improvement(*pair) for pair in pairs]


def test_one_seed_has_no_interval():
    one = np.array([[1.0, 2.0]])
    assert np.isnan(band_over_seeds(one).lows).all()
    assert np.isnan(over_seeds(one, np.mean)[1:]).all()
    assert np.isnan(probability_of_improvement(one, one)[1:]).all()
    assert np.isnan(improvement_of_few_seeds(one, one)[1:]).all()


def test_scores_of_other_numbers_of_volumes_are_refused():
    with pytest.raises(InvalidValueError, match="scores are of 2 and of 3 volumes"):
        probability_of_improvement(np.zeros((3, 2)), np.zeros((3, 3)))

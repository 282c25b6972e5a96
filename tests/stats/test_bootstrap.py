"""Intervals, compared with NumPy's and SciPy's statistics and known values, and their coverage."""

import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from armscan.errors import InvalidValueError
from armscan.stats.bootstrap import estimates, interquartile_mean, mean, quantile


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.95, 1.0])
def test_statistics_leave_out_what_is_not_there(share):
    samples = np.random.default_rng(0).normal(size=(50, 7))
    samples[np.random.default_rng(1).random(samples.shape) < 0.5] = np.nan
    samples[3] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        np.testing.assert_allclose(mean(samples), np.nanmean(samples, axis=1))
        np.testing.assert_allclose(quantile(share)(samples), np.nanquantile(samples, share, axis=1))


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30))
def test_interquartile_mean_is_the_trimmed_mean_of_what_is_there(values):
    assert interquartile_mean(np.array([math.nan, *values])) == pytest.approx(stats.trim_mean(values, 0.25), abs=1e-6)


def test_interval_of_one_volume_is_the_usual_bootstrap_of_its_episodes():
    values = np.random.default_rng(0).exponential(size=60)
    ours = estimates({"m": (mean, values)}, ["v"] * 60)["m"]
    theirs = stats.bootstrap([values], np.mean, method="percentile", rng=1).confidence_interval
    assert ours.value == pytest.approx(values.mean())
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=0.02)


def test_interval_of_volumes_that_differ_is_wider_than_one_of_their_episodes():
    values = [0.0] * 50 + [1.0] * 50 + [0.0] * 50 + [1.0] * 50
    by_volume = estimates({"m": (mean, values)}, [place // 50 for place in range(200)])["m"]
    as_one = estimates({"m": (mean, values)}, [0] * 200)["m"]
    assert (by_volume.low, by_volume.high) == (0.0, 1.0)
    assert as_one.low > 0.4
    assert as_one.high < 0.6


def test_volumes_with_fewer_episodes_count_by_their_episodes():
    ours = estimates({"m": (mean, [1.0] * 30 + [0.0] * 10)}, ["a"] * 30 + ["b"] * 10)["m"]
    assert ours == (0.75, 0.0, 1.0)


def test_episodes_that_are_left_out_are_left_out():
    values = [math.nan] * 10 + [2.0] * 10
    assert estimates({"m": (mean, values)}, ["a", "b"] * 10)["m"] == (2.0, 2.0, 2.0)
    assert all(map(math.isnan, estimates({"m": (mean, [math.nan] * 3)}, ["a"] * 3)["m"]))


def test_the_same_episodes_give_the_same_interval():
    values = np.random.default_rng(0).normal(size=40)
    volumes = ["a", "b", "c", "d"] * 10
    first, second = (estimates({"m": (mean, values)}, volumes)["m"] for _ in range(2))
    assert first == second
    assert first.low < first.value < first.high


def test_intervals_of_many_episodes_are_drawn_in_parts(monkeypatch):
    monkeypatch.setattr("armscan.stats.bootstrap.MAX_VALUES", 1000)
    ours = estimates({"m": (mean, list(range(100)))}, ["a", "b"] * 50)["m"]
    assert ours.low < 49.5 < ours.high


def test_intervals_hold_the_truth_about_as_often_as_they_say():
    rng = np.random.default_rng(0)
    volumes = [place // 20 for place in range(8 * 20)]
    n_by_volume = n_as_one = 0
    for _ in range(200):
        rates = rng.beta(4, 2, size=8)
        successes = (rng.random((8, 20)) < rates[:, None]).ravel().astype(float)
        by_volume, as_one = (estimates({"m": (mean, successes)}, each)["m"] for each in (volumes, [0] * 160))
        n_by_volume += by_volume.low <= 2 / 3 <= by_volume.high
        n_as_one += as_one.low <= 2 / 3 <= as_one.high
    # With eight volumes a bootstrap is somewhat too narrow; one that takes episodes as independent is far too narrow.
    assert n_by_volume >= 175
    assert n_as_one <= 160


@pytest.mark.parametrize("volumes", [[], ["a"]])
def test_estimates_refuse_columns_that_do_not_fit(volumes):
    with pytest.raises(InvalidValueError, match="one value for each episode"):
        estimates({"m": (mean, [1.0, 2.0])}, volumes)
    with pytest.raises(InvalidValueError, match="one value for each episode"):
        estimates({"m": (mean, [])}, [])


@pytest.mark.parametrize("trainings", [None, ["a"] * 40])
def test_one_training_leaves_intervals_as_they_are(trainings):
    values, volumes = np.random.default_rng(0).normal(size=40), ["a", "b", "c", "d"] * 10
    assert estimates({"m": (mean, values)}, volumes, trainings=trainings) == estimates({"m": (mean, values)}, volumes)


def test_interval_of_trainings_that_differ_is_wider_than_one_of_their_episodes():
    values, volumes = [0.0] * 40 + [1.0] * 40 + [0.0] * 40 + [1.0] * 40, ["a", "b"] * 80
    by_training = estimates({"m": (mean, values)}, volumes, trainings=[place // 40 for place in range(160)])["m"]
    as_one = estimates({"m": (mean, values)}, volumes)["m"]
    assert (by_training.value, by_training.low, by_training.high) == (0.5, 0.0, 1.0)
    assert as_one.low > 0.4


def test_all_trainings_meet_the_same_drawn_volumes():
    # All fail on one volume of two: it is drawn twice, once or not at all, for all of them alike.
    volumes, trainings = ["a", "b"] * 30, [place // 6 for place in range(60)]
    ours = estimates({"m": (mean, [0.0, 1.0] * 30)}, volumes, trainings=trainings)["m"]
    assert ours == (0.5, 0.0, 1.0)


def test_volumes_that_a_training_has_not_met_are_left_out():
    ours = estimates({"m": (mean, [1.0] * 4 + [3.0] * 4)}, list("aaaabbbb"), trainings=list("xxxxyyyy"))["m"]
    assert ours == (2.0, 1.0, 3.0)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3), st.floats(-5, 5)), min_size=2, max_size=30))
@settings(max_examples=40)
def test_intervals_lie_within_what_was_measured(episodes):
    trainings, volumes, values = zip(*episodes, strict=True)
    ours = estimates({"m": (mean, values)}, volumes, trainings=trainings)["m"]
    assert min(values) - 1e-9 <= ours.low <= ours.high <= max(values) + 1e-9
    assert ours.value == pytest.approx(np.mean(values), abs=1e-9)


@pytest.mark.parametrize(
    "values", [[2.0, np.nan, np.nan], [2.0, 3.0, np.nan]], ids=["one episode", "one of two wrists"]
)
def test_figure_of_one_episode_or_one_of_several_wrists_has_no_interval(values):
    figures = estimates({"m": (mean, values), "all": (mean, [1.0, 2.0, 3.0])}, ["a", "a", "b"])
    assert np.isnan(figures["m"][1:]).all()
    assert figures["m"].value == np.nanmean(values)
    assert figures["all"].low < figures["all"].high


def test_trainings_must_be_as_many_as_episodes():
    with pytest.raises(InvalidValueError, match="one value for each episode"):
        estimates({"m": (mean, [1.0, 2.0])}, ["a", "a"], trainings=["a"])

"""The interval of a paired difference holds a known truth as often as it says, for few seeds and volumes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armscan.errors import InvalidValueError
from armscan.stats.paired import crossed_mean, of_subjects, paired_difference, weighted_by_volume

N_STUDIES = 4000


def drawn(rng, n_seeds, n_volumes, of_seeds, of_volumes, of_cells):
    """Differences of many studies around 0, shape (studies, seeds, volumes)."""
    effects = (
        of_seeds * rng.standard_normal((N_STUDIES, n_seeds, 1)),
        of_volumes * rng.standard_normal((N_STUDIES, 1, n_volumes)),
        of_cells * rng.standard_normal((N_STUDIES, n_seeds, n_volumes)),
    )
    return sum(effects)


@pytest.mark.parametrize("spread", [(1.0, 0.3, 1.0), (0.3, 1.0, 1.0), (0.7, 0.7, 0.5), (1.0, 0.0, 0.5)])
@pytest.mark.parametrize(("n_seeds", "n_volumes"), [(3, 8), (3, 12), (5, 4), (5, 8), (10, 4), (10, 12)])
def test_interval_holds_the_truth_in_92_to_98_percent_of_studies(n_seeds, n_volumes, spread):
    means, halves = crossed_mean(drawn(np.random.default_rng(0), n_seeds, n_volumes, *spread))
    assert 0.92 <= (np.abs(means) <= halves).mean() <= 0.98


@pytest.mark.parametrize("spread", [(1.0, 0.4, 0.5), (0.3, 0.4, 0.5), (1.0, 3.0, 0.5), (1.0, 0.0, 0.5)])
@pytest.mark.parametrize(("n_seeds", "n_volumes"), [(2, 4), (2, 8), (2, 12), (3, 4), (5, 2), (10, 2)])
def test_interval_of_two_seeds_or_volumes_holds_the_truth_in_94_to_99_percent_of_studies(n_seeds, n_volumes, spread):
    means, halves = crossed_mean(drawn(np.random.default_rng(0), n_seeds, n_volumes, *spread))
    assert 0.94 <= (np.abs(means) <= halves).mean() <= 0.99


@pytest.mark.parametrize("spread", [(1.0, 0.3, 1.0), (0.3, 1.0, 1.0), (0.7, 0.7, 0.5)])
def test_interval_over_subjects_with_several_volumes_holds_the_truth_as_often_as_it_says(spread):
    rng, n_seeds, of_subject = np.random.default_rng(0), 5, np.repeat(np.arange(12), [4, 3, 2, 2, *[1] * 8])
    alike = drawn(rng, n_seeds, 12, *spread)[..., of_subject]
    values = alike + 0.2 * rng.standard_normal(alike.shape)
    covered = []
    for each in (of_subjects(values, of_subject.astype(str)), values):
        means, halves = crossed_mean(each)
        np.testing.assert_allclose(means, values.mean(axis=(1, 2)))
        covered.append((np.abs(means) <= halves).mean())
    assert 0.92 <= covered[0] <= 0.98
    assert covered[1] < covered[0]


def test_interval_of_one_seed_is_for_other_volumes_and_that_of_one_volume_for_other_seeds():
    values = np.random.default_rng(0).standard_normal((N_STUDIES, 1, 6))
    of_volumes, of_seeds = crossed_mean(values), crossed_mean(values.swapaxes(1, 2))
    assert np.allclose(of_volumes, of_seeds)
    # For one kind alone it is Student's.
    mean, half = values[0].mean(), 2.5706 * values[0].std(ddof=1) / np.sqrt(6)
    assert (of_volumes[0][0], of_volumes[1][0]) == pytest.approx((mean, half), rel=1e-4)


def test_difference_of_equal_trainings_has_no_width_and_that_of_one_seed_no_interval():
    assert paired_difference(np.full((3, 4), 2.0), np.full((3, 4), 1.5)) == (0.5, 0.5, 0.5)
    for n_volumes in (1, 4):
        value, low, high = paired_difference(np.arange(n_volumes)[np.newaxis] + 0.5, np.arange(n_volumes)[np.newaxis])
        assert value == 0.5
        assert np.isnan([low, high]).all()


def test_interval_of_seeds_with_equal_means_is_hardly_wider_than_of_nearly_equal_ones():
    scores = np.tile(np.array([0.1, 0.2, 0.3, 0.4, 0.2, 0.3, 0.2, 0.3]), (2, 1))
    scores[1, :2] = scores[1, 1::-1]
    nearly = scores + np.array([[0.0], [1e-6]])
    halves = [crossed_mean(each)[1] for each in (scores, nearly)]
    assert halves[0] == pytest.approx(halves[1], rel=0.01)


def test_differences_whose_means_are_equal_by_chance_have_an_interval():
    differences = np.array([[0.5, 0.1], [0.1, 0.5]])
    value, low, high = paired_difference(differences, np.zeros((2, 2)))
    assert (value, high - value) == pytest.approx((0.3, value - low))
    assert low < value


@given(st.data())
@settings(max_examples=30)
def test_weighted_values_have_the_weighted_mean(data):
    n = data.draw(st.integers(1, 6))
    counts = np.array(data.draw(st.lists(st.integers(1, 9), min_size=n, max_size=n)))
    values = np.array(data.draw(st.lists(st.lists(st.floats(-5, 5), min_size=n, max_size=n), min_size=2, max_size=2)))
    weighted = weighted_by_volume(values, counts / counts.mean())
    assert weighted.mean() == pytest.approx(np.average(values, axis=1, weights=counts).mean(), abs=1e-9)


def test_trainings_of_other_seeds_or_volumes_are_refused():
    with pytest.raises(InvalidValueError, match=r"the shapes \(2, 3\) and \(3, 3\)"):
        paired_difference(np.zeros((2, 3)), np.zeros((3, 3)))


def test_interval_ends_at_the_largest_difference_that_there_can_be():
    ours, theirs = np.array([[0.0, 1.0, 0.5], [0.0, 1.0, 0.5]]), np.array([[1.0, 0.0, 0.5], [1.0, 0.0, 0.5]])
    assert paired_difference(ours, theirs).clipped(-1.0, 1.0) == (0.0, -1.0, 1.0)
    assert paired_difference(ours, theirs).high > 1.0

"""Curves of several seeds that stop at different steps."""

import numpy as np

from armscan.reports.curves import MAX_POINTS, curve_of
from armscan.reports.groups import group_trainings

FIGURE, RATE, RETURN = "validation/mean_steps", "validation/success_rate", "validation/mean_return"
STEPS, SECONDS = "environment steps", "seconds of training"


def curve(*trainings, axis=STEPS):
    (group,), _ = group_trainings(trainings)
    return curve_of(group, FIGURE, axis)


def test_a_training_that_has_finished_is_carried_on_with_its_last_value(make_training):
    early = make_training(0, steps=(100, 200), values=(10.0, 2.0))
    late = make_training(1, steps=(100, 200, 300, 400), values=(10.0, 8.0, 6.0, 4.0))
    ours = curve(early, late)
    assert ours.places.tolist() == [100, 200, 300, 400]
    assert ours.band.values.tolist() == [10.0, 5.0, 4.0, 3.0]
    assert [len(places) for places, _ in ours.lines.values()] == [2, 4]


def test_a_band_stays_within_the_bounds_of_its_metric_and_takes_three_seeds(make_training):
    trainings = [make_training(seed, steps=(100, 200), values=(0.2 * seed, 1.0)) for seed in range(3)]
    for training in trainings:
        training.series.update(dict.fromkeys((RATE, RETURN), training.series[FIGURE]))
    (group,), _ = group_trainings(trainings)
    rate, returned = (curve_of(group, figure, STEPS).band for figure in (RATE, RETURN))
    assert returned.lows[0] < 0.0 == rate.lows[0]
    assert rate.highs.tolist() == returned.highs.tolist()
    assert np.isnan(curve(*trainings[:2]).band.lows).all()


def test_the_curve_ends_with_a_training_that_has_not_run_to_its_end(make_training):
    cut = make_training(0, steps=(100, 200), values=(10.0, 2.0), is_whole=False)
    late = make_training(1, steps=(100, 200, 300), values=(10.0, 8.0, 6.0))
    assert curve(cut, late).places.tolist() == [100, 200]


def test_the_curve_ends_where_a_metric_of_a_training_became_nan(make_training):
    diverged = make_training(0, steps=(100, 200, 300), values=(10.0, np.nan, np.nan))
    diverged.series[RATE] = make_training(0, steps=(100, 200, 300), values=(0.0, 0.5, 1.0)).series[RATE]
    assert curve(diverged, make_training(1, steps=(100, 200, 300), values=(10.0, 8.0, 6.0))).places.tolist() == [100]


def test_the_curve_begins_where_all_are_known_and_is_straight_between_validations(make_training):
    ours = curve(
        make_training(0, steps=(100, 300), values=(0.0, 2.0)), make_training(1, steps=(200, 300), values=(5.0, 5.0))
    )
    assert ours.places.tolist() == [200, 300]
    assert ours.band.values.tolist() == [3.0, 3.5]


def test_curves_over_seconds_are_of_the_same_values(make_training):
    ours = curve(make_training(0), make_training(1), axis=SECONDS)
    assert ours.places.tolist() == [2.0, 4.0]
    assert ours.band.values.tolist() == [0.0, 1.0]


def test_trainings_without_validation_have_no_curve(make_training):
    assert curve(make_training(0, steps=(), values=())) is None
    assert curve(make_training(0, steps=(), values=()), make_training(1)).n_seeds == 1


def test_long_curves_are_drawn_by_fewer_points(make_training):
    steps = tuple(range(1, 1001))
    ours = curve(make_training(0, steps=steps, values=steps), make_training(1, steps=steps, values=steps))
    assert len(ours.places) == MAX_POINTS
    assert np.allclose(ours.band.values, ours.places)


def test_folds_of_a_seed_are_averaged_and_are_no_further_seeds(make_training):
    trainings = [
        make_training(seed, steps=(100, 200), values=(value, value), params={"data.folds": "2", "data.fold": str(fold)})
        for seed, of_folds in enumerate(((1.0, 3.0), (5.0, 7.0)))
        for fold, value in enumerate(of_folds)
    ]
    ours = curve(*trainings)
    assert (ours.n_seeds, len(ours.lines)) == (2, 4)
    assert ours.band.values.tolist() == [4.0, 4.0]
    # As of any two seeds.
    assert np.isnan(ours.band.lows).all()


def test_fold_that_one_seed_lacks_is_left_out(make_training):
    trainings = [
        make_training(seed, steps=(100, 200), values=(value, value), params={"data.folds": "2", "data.fold": str(fold)})
        for seed, fold, value in ((0, 0, 1.0), (0, 1, 9.0), (1, 0, 3.0))
    ]
    assert curve(*trainings).band.values.tolist() == [2.0, 2.0]


def test_values_that_are_not_finite_are_left_out(make_training):
    ours = curve(make_training(0, steps=(100, 200, 300), values=(1.0, np.nan, 3.0)))
    assert (ours.places.tolist(), ours.band.values.tolist()) == ([100, 300], [1.0, 3.0])


def test_the_first_training_to_be_cut_off_ends_the_curve(make_training):
    cut = [
        make_training(seed, steps=range(100, end + 1, 100), values=[1.0] * (end // 100), is_whole=False)
        for seed, end in enumerate((300, 200))
    ]
    assert curve(*cut, make_training(2, steps=(100, 400), values=(1.0, 1.0))).places.tolist() == [100, 200]

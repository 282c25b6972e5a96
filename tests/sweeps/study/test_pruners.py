"""Pruners: fronts and crowding by brute force, which trials go on, and that a retried trial counts once."""

import itertools
import math

import hypothesis.extra.numpy as arrays
import numpy as np
import optuna
import pytest
from hypothesis import given
from hypothesis import strategies as st
from optuna.trial import TrialState

from armscan.errors import InvalidValueError, StudyError
from armscan.sweeps.storage.attribute_names import RETRIED
from armscan.sweeps.storage.reports import reports_of, store_report
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.components import read_settings
from armscan.sweeps.study.pruners import HalvingPruner, ParetoPruner, crowding_distances, front_numbers, n_better

# Few values, so that ties and repeated rows are common.
LOSSES = arrays.arrays(
    float,
    st.tuples(st.integers(1, 12), st.integers(1, 3)),
    elements=st.sampled_from([0.0, 0.25, 1.0, 3.0, math.inf]),
)


def dominates(first, second):
    return all(a <= b for a, b in zip(first, second, strict=True)) and tuple(first) != tuple(second)


@given(LOSSES)
def test_front_of_a_trial_is_the_longest_chain_of_trials_that_dominate_it(losses):
    def chain(row):
        return max((1 + chain(other) for other in losses if dominates(other, row)), default=0)

    assert front_numbers(losses).tolist() == [chain(row) for row in losses]


@given(LOSSES)
def test_order_by_front_and_crowding_is_the_same_for_every_trial(losses):
    counts = []
    for index in range(len(losses)):
        others = np.delete(losses, index, axis=0)
        counts.append(n_better(np.vstack([losses[index], others])))
    fronts = front_numbers(losses)
    for one, other in itertools.product(range(len(losses)), repeat=2):
        if fronts[one] < fronts[other]:
            assert counts[one] < counts[other]
    assert all((count == 0) for count, front in zip(counts, fronts, strict=True) if front == 0)


@given(LOSSES, st.floats(0.1, 100.0))
def test_crowding_does_not_depend_on_the_unit_of_an_objective(losses, factor):
    scaled = losses.copy()
    scaled[:, 0] *= factor
    np.testing.assert_allclose(crowding_distances(losses), crowding_distances(scaled), rtol=1e-6)


def test_crowding_of_three_trials_in_a_row():
    losses = np.array([[0.0, 4.0], [1.0, 1.0], [4.0, 0.0]])
    assert crowding_distances(losses).tolist() == [math.inf, 2.0, math.inf]


def test_within_a_front_the_trial_whose_neighbours_are_farther_away_is_better():
    # The first dominates all others, which are one front: their crowding distances are inf, 1.5, 1.25 and inf.
    losses = np.array([[0.0, 0.0], [10.0, 14.0], [11.0, 12.0], [13.0, 11.0], [14.0, 10.0]])
    assert [n_better(np.roll(losses, -index, axis=0)) for index in range(5)] == [0, 1, 3, 4, 1]


@pytest.fixture
def report(storage_uri):
    """Report values of a trial at steps, as an attempt does; return the step at which it is pruned."""
    storage = open_storage(storage_uri)
    study = optuna.create_study(
        study_name="a", storage=storage.optuna, directions=["maximize", "minimize"], pruner=ParetoPruner(100, 2)
    )

    def run(values_at, ended=None):
        trial = study.ask()
        for step, values in values_at.items():
            store_report(storage.optuna, trial._trial_id, step, values)
            if study.pruner.prune(study, storage.optuna.get_trial(trial._trial_id)):
                study.tell(trial, state=TrialState.PRUNED)
                return step
        study.tell(trial, ended or values)
        return None

    run.study = study
    return run


def test_trial_that_others_dominate_is_pruned_at_its_first_report_on_a_rung(report):
    for good in (0.8, 0.9):
        assert report({100: (good, 5.0), 200: (good, 5.0)}) is None
    assert report({50: (0.0, 9.0), 100: (0.1, 9.0), 200: (0.1, 9.0)}) == 100
    assert report({100: (0.95, 5.0), 200: (0.0, 9.0)}) == 200
    # Later than the rung, because it reports rarely.
    assert report({150: (0.1, 9.0)}) == 150
    # Only between two rungs is it behind.
    assert report({100: (0.95, 5.0), 150: (0.0, 9.0), 200: (0.95, 5.0)}) is None


def test_front_goes_on_however_many_it_has(report):
    assert [report({100: (0.1 * each, 10.0 * each)}) for each in range(8)] == [None] * 8


def test_trials_with_the_same_values_go_on(report):
    assert [report({100: (0.0, 100.0)}) for _ in range(6)] == [None] * 6


def test_trial_that_ended_before_a_rung_is_compared_by_its_final_values(report):
    for _ in range(2):
        assert report({50: (0.9, 50.0)}, ended=(0.9, 50.0)) is None
    assert report({100: (0.5, 100.0)}) == 100


def test_trial_that_was_retried_counts_once(report):
    report.study.enqueue_trial({}, user_attrs={RETRIED: True})
    assert [report({100: values}) for values in [(0.9, 5.0)] * 2 + [(0.1, 9.0)] * 2] == [None, None, 100, 100]
    # The second-best of four; with the retried one it would be the third of five.
    assert report({100: (0.5, 6.0)}) is None


def test_halving_counts_a_retried_trial_once():
    ends = []
    for attrs in ({}, {RETRIED: True}):
        study = optuna.create_study(direction="minimize", pruner=HalvingPruner(min_resource=100, reduction_factor=4))
        study.enqueue_trial({}, user_attrs=attrs)
        trials = [study.ask() for _ in range(9)]
        for trial, value in zip(trials, (1.0, 1.0, *[9.0] * 6, 2.0), strict=True):
            trial.report(value, 100)
            ends.append(trial.should_prune())
    assert ends[8], "two of nine may go on"
    assert not ends[17], "the second-best of eight"


def test_trial_of_unknown_values_is_worst(report):
    assert report({100: (0.9, 5.0)}) is None
    assert report({100: (0.8, 5.0)}) == 100
    assert report({100: (math.nan, 5.0)}) == 100


def test_reports_of_several_objectives_are_read_again_and_do_not_disturb_the_sampler(report):
    report.study.sampler = optuna.samplers.TPESampler(n_startup_trials=2, seed=0)
    for _ in range(2):
        assert report({100: (0.9, 5.0)}) is None
    assert report({50: (0.5, 7.0), 100: (0.5, 7.0)}) == 100
    assert reports_of(report.study.trials[2]) == {50: (0.5, 7.0), 100: (0.5, 7.0)}
    # Optuna's TPE raises where a pruned trial of several objectives has intermediate values.
    for _ in range(3):
        trial = report.study.ask()
        report.study.tell(trial, (trial.suggest_float("x", 0.0, 1.0), 1.0))


@pytest.mark.parametrize("values", ["code", [1.0], [1.0, "2"], {"a": 1}])
def test_reports_that_a_stranger_has_written_are_refused(report, values):
    trial = report.study.ask()
    report.study._storage.set_trial_system_attr(trial._trial_id, "report:100", values)
    with pytest.raises(StudyError, match=r"the system attribute report:100: .* must be 2 numbers at a step"):
        report.study.get_trials()


@pytest.mark.parametrize(("argument", "value"), [("min_resource", 0), ("reduction_factor", 1), ("min_resource", 1.5)])
def test_too_small_numbers_are_refused(argument, value):
    with pytest.raises(InvalidValueError, match=f"{argument} is {value}, but it must be a whole number of at least"):
        ParetoPruner(**{"min_resource": 100} | {argument: value})


def test_pruners_of_one_value_are_refused_for_several_objectives():
    words = ["sweep=speed_vs_success", "study/pruner=median"]
    with pytest.raises(InvalidValueError, match=r"MedianPruner, which compares one objective, .*study/pruner=pareto"):
        read_settings(words)
    assert read_settings(words[:1])[0].sampler["_target_"] == "optuna.samplers.TPESampler"

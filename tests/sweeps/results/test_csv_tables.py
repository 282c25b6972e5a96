"""Rows of a study's CSV files."""

import numpy as np
import optuna
import pytest

from armscan.stats.bootstrap import Estimate
from armscan.sweeps.results.csv_tables import _difference_rows, _importance_rows, all_numbers
from armscan.sweeps.results.difference import Difference
from armscan.sweeps.results.study_result import StudyResult
from armscan.sweeps.storage.attribute_names import FAILURE, OBJECTIVES, RETRIED, RETRY_OF


def test_differences_have_the_probability_beside_the_difference():
    difference = Difference("success_rate", True, Estimate(0.1, 0.0, 0.2), Estimate(0.7, 0.5, 0.9))
    result = StudyResult(
        chosen=3, results=(), differences=(difference,), n_seeds=2, n_planned=2, others=(), settings={}
    )
    (row,) = _difference_rows(result)
    assert [row[name] for name in ("probability", "probability_low", "probability_high")] == [0.7, 0.5, 0.9]


def test_reports_of_a_retried_trial_are_those_of_its_retry_alone():
    study = optuna.create_study()
    study.set_user_attr(OBJECTIVES, ["steps"])
    for attributes in ({RETRIED: True}, {RETRY_OF: 0}):
        study.enqueue_trial({}, user_attrs=attributes)
        trial = study.ask()
        trial.report(3.0, 100)
        study.tell(trial, 3.0)
    rows = all_numbers(study, study.trials, found=(), candidates=(), result=None)["reports"]
    assert rows == [{"trial": 1, "step": 100, "objective": "steps", "value": 3.0}]


def test_retried_trials_are_told_from_failed_ones():
    study = optuna.create_study()
    study.set_user_attr(OBJECTIVES, ["steps"])
    for attributes in ({RETRIED: True, FAILURE: "its worker died"}, {FAILURE: "its worker died"}):
        study.enqueue_trial({}, user_attrs=attributes)
        study.tell(study.ask(), state=optuna.trial.TrialState.FAIL)
    rows = all_numbers(study, study.trials, found=(), candidates=(), result=None)
    assert [row["retried"] for row in rows["trials"]] == [True, False]
    assert [row["cause"] for row in rows["failures"]] == ["its worker died, retried", "its worker died"]
    assert [row["cause"] for row in rows["endings"]] == ["its worker died", "its worker died, retried"]


@pytest.mark.parametrize("direction", ["maximize", "minimize"])
def test_importances_of_each_of_several_objectives_explain_its_best_trials(direction):
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sign = 1.0 if direction == "maximize" else -1.0
    rows = []
    for n_objectives in (1, 2):
        study = optuna.create_study(
            directions=[direction] * n_objectives, sampler=optuna.samplers.RandomSampler(seed=0)
        )
        for _ in range(60):
            trial = study.ask()
            x, y = (trial.suggest_float(name, 0.0, 1.0) for name in "xy")
            study.tell(trial, [sign * (x if x > 0.5 else 0.5 * y)] * n_objectives)
        rows.append(_importance_rows(study, ["a", "b"][:n_objectives]))
    assert rows[1][:2] == rows[0] != []


def importances(trials):
    """Return the importances of trials: values `x` and `y`, the objective, and the violation of a constraint."""
    study = optuna.create_study(direction="minimize")
    of_xy = dict.fromkeys("xy", optuna.distributions.FloatDistribution(0.0, 1.0))
    study.add_trials(
        optuna.create_trial(value=value, params={"x": x, "y": y}, distributions=of_xy, constraints={"a": violation})
        for x, y, value, violation in trials
    )
    return {row["key"]: row["importance"] for row in _importance_rows(study, ["steps"])}


def test_importances_leave_out_trials_that_violate_a_constraint():
    points = np.random.default_rng(0).random((80, 2))
    # Where y is large, trials violate it and are best.
    found = importances((x, y, x - 9.0 * (y > 0.85), y - 0.85) for x, y in points.tolist())
    assert found["x"] > 0.9


def test_trials_that_are_all_equal_have_no_importances():
    assert importances((x, x, 1.0, -1.0) for x in np.linspace(0.0, 1.0, 20).tolist()) == {}

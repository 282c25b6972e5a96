"""The charts of a study's report."""

import html

import optuna
import pytest
from optuna.distributions import FloatDistribution
from optuna.study import StudyDirection
from optuna.trial import create_trial

from armscan.reports.chart_style import BLUE, GREY
from armscan.sweeps.results.charts import _history, _slice, charts_of, key_axis


def test_best_so_far_is_of_trials_that_satisfy_all_constraints():
    study = optuna.create_study()
    for value, violation in ((3.0, -0.1), (1.0, 0.5), (2.0, 0.0)):
        study.add_trial(create_trial(value=value, constraints={"training_s <= 60": violation}))
    figure = _history(study.trials, 0, "mean_steps", StudyDirection.MINIMIZE)
    drawn = {trace.name: list(zip(trace.x, trace.y, strict=True)) for trace in figure.data}
    assert drawn == {
        "trial": [(0, 3.0), (2, 2.0)],
        "infeasible trial": [(1, 1.0)],
        "best so far": [(0, 3.0), (2, 2.0)],
    }


def test_trials_that_violate_a_constraint_are_drawn_as_such():
    study, space = optuna.create_study(), {"agent.lr": FloatDistribution(1e-4, 1e-2)}
    for value, violation in ((3.0, -0.1), (1.0, 0.5)):
        given = {"params": {"agent.lr": 1e-3}, "distributions": space, "constraints": {"training_s <= 60": violation}}
        study.add_trial(create_trial(value=value, **given))
    (slice_,) = _slice(study.trials, "agent.lr", 0, "mean_steps").data
    assert slice_.marker.color == (BLUE, GREY)
    for trials, is_said in ((study.trials, True), (study.trials[:1], False)):
        shown = "".join(charts_of(study, trials, ["mean_steps"], []))
        assert ("Grey: trials that violate a constraint." in shown) == is_said
        assert ("Dotted: trials that violate a constraint." in shown) == is_said
    assert '"dash":"dot"' in "".join(charts_of(study, study.trials, ["mean_steps"], []))


@pytest.mark.parametrize(("n_objectives", "n_fronts"), [(1, 0), (2, 1), (3, 1), (4, 0)])
def test_front_is_drawn_of_two_or_three_objectives(n_objectives, n_fronts):
    study = optuna.create_study(directions=["minimize"] * n_objectives)
    study.tell(study.ask(), [1.0] * n_objectives)
    names = ["mean_steps", "mean_return", "success_rate", "training_s"][:n_objectives]
    shown = "".join(charts_of(study, study.trials, names, []))
    assert shown.count("<h2>Pareto front</h2>") == n_fronts


def test_names_of_objectives_in_a_storage_are_escaped():
    study, name = optuna.create_study(), "<script>alert(1)</script>"
    trial = study.ask()
    trial.report(1.0, 10)
    study.tell(trial, 1.0)
    shown = "".join(charts_of(study, study.trials, [name], []))
    assert "<script>alert" not in shown
    assert html.escape(name) in shown


@pytest.mark.parametrize(("low", "high", "labelled"), [(0.05, 0.5, "D2"), (1e-4, 1e-2, 1)])
def test_axis_of_a_short_logarithmic_range_has_more_numbers_than_powers_of_ten(low, high, labelled):
    axis = key_axis("agent.utd_ratio", FloatDistribution(low, high, log=True))
    assert (axis["type"], axis["dtick"]) == ("log", labelled)

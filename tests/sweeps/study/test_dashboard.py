"""Attributes and pictures of trials for Optuna's dashboard."""

import math

import optuna
import pytest

from armscan.sweeps.study.dashboard import named_as_of_runs, shown_metrics, table_of_seeds
from armscan.sweeps.study.study import name_objectives

METRICS = {
    "on_plane_5mm_10deg": 0.9375,
    "median_distance_mm": 1.23456789,
    "success_rate": 1.0,
    "mean_steps": 3.0,
    "training_s": math.nan,
    "env_steps": 12000.0,
    "mean_return": -3.0,
}


def test_table_of_seeds_is_rounded_and_called_as_people_call_it():
    assert table_of_seeds({0: METRICS, 7: METRICS}).splitlines() == [
        "| validation volumes; cost in all | seed 0 | seed 7 |",
        "| --- | ---: | ---: |",
        "| on plane, 5 mm 10° | 93.8% | 93.8% |",
        "| distance mm, median | 1.2 | 1.2 |",
        "| success, by reward | 100.0% | 100.0% |",
        "| steps, mean | 3.00 | 3.00 |",
        "| environment steps | 12,000 | 12,000 |",
        "| training, s | – | – |",
    ]


def test_shown_metrics_are_few_and_say_their_statistic():
    assert shown_metrics(METRICS, 1) == {
        "on plane, 5 mm 10°": 0.9375,
        "distance mm, median": 1.235,
        "success, by reward": 1.0,
        "steps, mean": 3.0,
    }
    assert "steps, mean (IQM of 2 seeds)" in shown_metrics(METRICS, 2)
    assert shown_metrics({"test/mean_steps": 2.0, **METRICS}, 1) == {"test volumes: steps, mean": 2.0}


@pytest.mark.parametrize("prefix", ["validation/", "selection/"])
def test_metrics_of_a_trial_have_the_names_of_runs_and_those_of_the_race_names_of_their_own(prefix):
    named = named_as_of_runs(METRICS | {"test/mean_steps": 2.0}, 2, prefix)
    assert named["test_volumes/mean_steps"] == 2.0
    assert {name: value for name, value in named.items() if "test" not in name} == {
        f"{prefix}on_plane_5mm_10deg": 0.9375,
        f"{prefix}median_distance_mm": 1.23456789,
        f"{prefix}success_rate": 1.0,
        f"{prefix}mean_steps": 3.0,
        f"{prefix}seeds": 2.0,
    }


def test_objectives_have_names_also_in_a_study_that_has_none_yet():
    study = optuna.create_study(directions=["maximize", "minimize"])
    name_objectives(study, ["success_rate", "env_steps"])
    assert study.metric_names == ["success_rate", "env_steps"]
    name_objectives(study, ["other", "names"])
    assert study.metric_names == ["success_rate", "env_steps"]

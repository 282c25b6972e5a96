"""Metrics of episodes, with intervals."""

import dataclasses

import numpy as np
import pytest

from armscan.training import Evaluation, MetricEstimates
from armscan.training.metrics import SEEDS
from tests.training.test_train import episode_of, evaluation_of


def test_figures_agree_with_the_metrics_of_training():
    episodes = evaluation_of(1, 3, 50).episodes
    episodes = tuple(
        dataclasses.replace(episode, starts_solved=index == 0, volume=str(index))
        for index, episode in enumerate(episodes)
    )
    evaluation = Evaluation(episodes)
    figures = MetricEstimates.of(evaluation)
    metrics = figures.metrics()
    for name, value in evaluation.metrics().items():
        assert metrics[name] == pytest.approx(value), name
    assert (figures.n_volumes, figures.n_episodes, figures.n_started_solved) == (3, 3, 1)
    assert metrics["median_steps"] == 3.0
    assert metrics["p95_steps"] == pytest.approx(45.3)
    assert metrics["median_steps_not_started_solved"] == 26.5
    assert metrics["mean_steps_low"] <= 18.0 <= metrics["mean_steps_high"]
    assert metrics["mean_dice_artery"] == pytest.approx(0.7)
    assert metrics["success_rate_wilson_low"] == pytest.approx(0.4385, abs=1e-4)


def test_figures_of_several_trainings_are_the_same_once_they_are_tracked():
    trainings = {seed: evaluation_of(1 + seed, 3, 50) for seed in (0, 1)}
    figures = MetricEstimates.of_trainings(trainings)
    metrics = figures.metrics()
    assert (figures.n_seeds, metrics[SEEDS]) == (2, 2)
    again = MetricEstimates.of_metrics(metrics)
    assert again.counts == figures.counts
    assert again.metrics() == pytest.approx(metrics, nan_ok=True)
    assert again.estimates.keys() == figures.estimates.keys()
    # All succeed, so only Wilson's interval has a width.
    sure = MetricEstimates.of(evaluation_of(1, 3))
    assert sure.estimate("success_rate") == sure.estimates["success_rate_wilson"]
    assert SEEDS not in sure.metrics()


def test_rate_that_was_measured_on_one_of_several_wrists_has_no_interval():
    episodes = [episode_of(volume=f"v{k}", starts_solved=k > 0, is_success=i > 2) for k in range(4) for i in range(6)]
    estimate = MetricEstimates.of(Evaluation(tuple(episodes))).estimate("success_rate_not_started_solved")
    assert estimate.value == 0.5
    assert np.isnan(estimate[1:]).all()


def test_figures_of_episodes_that_all_start_solved_are_not_those_of_others():
    metrics = MetricEstimates.of(Evaluation((episode_of(starts_solved=True),) * 2)).metrics()
    assert metrics["success_rate"] == 1.0
    assert metrics["success_rate_not_started_solved"] != metrics["success_rate_not_started_solved"]


def test_errors_of_the_surest_and_the_least_sure_quarter_are_those_of_the_episodes_themselves():
    episodes = tuple(
        episode_of(seed=i, distance_mm=float(i), distance_deg=1.0, expected_mm=10.0 - i, expected_deg=float(i))
        for i in range(8)
    )
    figures = MetricEstimates.of(Evaluation(episodes))
    assert figures.estimate("median_distance_mm_surest_quarter").value == 6.5
    assert figures.estimate("median_distance_mm_least_sure_quarter").value == 0.5
    assert figures.estimate("median_expected_mm").value == 6.5
    without = dataclasses.replace(episodes[0], expected_mm=None, expected_deg=None)
    assert not any("quarter" in name for name in MetricEstimates.of(Evaluation((*episodes, without))).estimates)

"""Display of metrics: titles, bounds, and values as strings."""

import math

import pytest

from armscan.stats.bootstrap import Estimate
from armscan.training.metric_display import bounds_of, interval_text, title_of, value_text


@pytest.mark.parametrize(
    ("metric", "bounds"),
    [
        ("validation/success_rate", (0.0, 1.0)),
        ("on_plane_5mm_10deg", (0.0, 1.0)),
        ("mean_dice_bones", (0.0, 1.0)),
        ("test/mean_steps", (1.0, math.inf)),
        ("median_distance_mm", (0.0, math.inf)),
        ("p95_steps", (1.0, math.inf)),
        ("test/mean_steps_not_started_solved", (1.0, math.inf)),
        ("success_rate_not_started_solved", (0.0, 1.0)),
        ("on_plane_5mm_10deg_not_started_solved", (0.0, 1.0)),
        ("validation/mean_return", (-math.inf, math.inf)),
        ("update/actor_loss", (-math.inf, math.inf)),
    ],
)
def test_bounds_of_a_metric_are_those_that_it_can_reach(metric, bounds):
    assert bounds_of(metric) == bounds


def test_metric_over_episodes_that_did_not_start_solved_is_shown_like_that_over_all():
    metric = "success_rate_not_started_solved"
    assert (title_of(metric), value_text(metric, 0.875)) == ("success, by reward, not started solved", "87.5%")
    assert value_text("mean_steps_not_started_solved", 1.2345) == value_text("mean_steps", 1.2345)


def test_interval_of_a_rate_that_is_not_quite_100_percent_is_shown():
    assert interval_text(Estimate(0.9998, 0.9995, 1.0), "{:.1%}") == ">99.9–100.0"

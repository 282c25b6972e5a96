"""Display of metrics: titles, bounds, and values as strings."""

import math

import pytest

from armscan.stats.bootstrap import Estimate
from armscan.training.metric_display import bounds_of, interval_text


@pytest.mark.parametrize(
    ("metric", "bounds"),
    [
        ("validation/success_rate", (0.0, 1.0)),
        ("on_plane_5mm_10deg", (0.0, 1.0)),
        ("mean_dice_bones", (0.0, 1.0)),
        ("test/mean_steps", (1.0, math.inf)),
        ("median_distance_mm", (0.0, math.inf)),
        ("validation/mean_return", (-math.inf, math.inf)),
        ("update/actor_loss", (-math.inf, math.inf)),
    ],
)
def test_bounds_of_a_metric_are_those_that_it_can_reach(metric, bounds):
    assert bounds_of(metric) == bounds


def test_interval_of_a_rate_that_is_not_quite_100_percent_is_shown():
    assert interval_text(Estimate(0.9998, 0.9995, 1.0), "{:.1%}") == ">99.9–100.0"

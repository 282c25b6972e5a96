"""Titles of metrics, and formats of their values."""

from __future__ import annotations

from collections.abc import Iterable

from armscan.stats.on_plane import limits_among
from armscan.training.result_table import QUANTITIES

TITLES = {
    **{each.metric: each.title for each in QUANTITIES},
    "mean_return": "return, mean",
    "mean_final_reward": "reward of the last plane, mean",
    "mean_best_reward": "best reward, mean",
    "mean_distance_mm": "distance mm, mean",
    "mean_distance_deg": "angle °, mean",
    "mean_dice": "Dice, mean",
    "env_steps": "environment steps",
    "training_s": "training, s",
    "solved": "solved, share of seeds",
}
# What a few lines have place for, beside the on-plane rates.
LEADING = ("median_distance_mm", "median_distance_deg", "success_rate", "mean_steps")
COSTS = ("env_steps", "training_s")
FORMS = {each.metric: each.form for each in QUANTITIES} | {"mean_return": "{:.2f}", "training_s": "{:.1f}"}


def leading_among(metrics: Iterable[str]) -> list[str]:
    """Return the names of the leading metrics among some, on-plane rates first."""
    known = list(metrics)
    return [*(limits.metric for limits in limits_among(known)), *(name for name in LEADING if name in known)]


def title_of(metric: str) -> str:
    """Return how people call a metric, with its statistic and unit, such as `steps, mean`."""
    limits = limits_among([metric])
    return limits[0].title if limits else TITLES.get(metric, metric.replace("_", " "))


def is_rate(metric: str) -> bool:
    """Return whether a metric is a share of episodes."""
    return "success_rate" in metric or bool(limits_among([metric.rpartition("/")[2]]))


def value_text(metric: str, value: float) -> str:
    """Return a value of a metric as tables show it: a share in percent, distances with one digit after the point."""
    form = "{:.1%}" if is_rate(metric) else "{:,.0f}" if abs(value) >= 1000 else FORMS.get(metric, "{:.4g}")
    return form.format(value)

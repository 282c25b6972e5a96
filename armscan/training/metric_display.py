"""Display of metrics: titles, formats and bounds; values and intervals as strings."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from armscan.stats.bootstrap import Estimate
from armscan.stats.on_plane import limits_among
from armscan.training.metrics import METRICS, NOT_STARTED_SOLVED
from armscan.utils.text import formatted
from armscan.volumes.labelmap import LANDMARKS


class Quantity(NamedTuple):
    """A metric as tables show it.

    Args:
        metric: Name of the metric.
        title: Title, the statistic last, such as `steps, mean`.
        form: Format of its value.
    """

    metric: str
    title: str
    form: str

    @property
    def heading(self) -> str:
        """The title in two lines, like the cells of a table."""
        return self.title.replace(", ", ",\n", 1)


QUANTITIES = (
    Quantity("median_distance_mm", "distance mm, median", "{:.1f}"),
    Quantity("p90_distance_mm", "distance mm, 90th percentile", "{:.1f}"),
    Quantity("median_distance_deg", "angle °, median", "{:.1f}"),
    Quantity("p90_distance_deg", "angle °, 90th percentile", "{:.1f}"),
    Quantity("median_expected_mm", "expected error mm, median", "{:.1f}"),
    Quantity("median_expected_deg", "expected error °, median", "{:.1f}"),
    Quantity("median_nerve_area_error_mm2", "nerve area error mm², median", "{:.2f}"),
    Quantity("median_nerve_area_error_percent", "nerve area error %, median", "{:.1f}"),
    Quantity("nerve_shown_rate", "nerve on labelled plane", "{:.1%}"),
    Quantity("success_rate", "success, by reward", "{:.1%}"),
    Quantity("mean_steps", "steps, mean", "{:.2f}"),
    Quantity("iqm_steps", "steps, IQM", "{:.2f}"),
    *(Quantity(f"mean_dice_{name}", f"Dice {name}, mean", "{:.2f}") for name in LANDMARKS),
)
# Metrics of older runs, shown only if the metric that replaced each is missing.
OLDER = {
    Quantity("mean_distance_mm", "distance mm, mean", "{:.1f}"): "median_distance_mm",
    Quantity("mean_distance_deg", "angle °, mean", "{:.1f}"): "median_distance_deg",
    Quantity("mean_dice", "Dice, mean", "{:.2f}"): "mean_dice_bones",
}
TITLES = {
    **{each.metric: each.title for each in (*QUANTITIES, *OLDER)},
    "mean_return": "return, mean",
    "mean_final_reward": "final reward, mean",
    "mean_best_reward": "best reward, mean",
    "env_steps": "environment steps",
    "training_s": "training, s",
    "solved": "solved, share of seeds",
}
# Shown where space is short, after the on-plane rates.
LEADING = ("median_distance_mm", "median_distance_deg", "success_rate", "mean_steps")
COSTS = ("env_steps", "training_s")
# Metrics in steps; an episode has one step at least.
STEPS = {name for name, (_, value) in METRICS.items() if value == "n_steps"}
FORMS = {each.metric: each.form for each in QUANTITIES} | {"mean_return": "{:.2f}", "training_s": "{:.1f}"}


def leading_among(metrics: Iterable[str]) -> list[str]:
    """Return the names of the leading metrics among some, on-plane rates first."""
    known = list(metrics)
    return [*(limits.metric for limits in limits_among(known)), *(name for name in LEADING if name in known)]


def title_of(metric: str) -> str:
    """Return the title of a metric, with its statistic and unit, such as `steps, mean`."""
    if metric.endswith(NOT_STARTED_SOLVED):
        return f"{title_of(metric.removesuffix(NOT_STARTED_SOLVED))}, not started solved"
    limits = limits_among([metric])
    return limits[0].title if limits else TITLES.get(metric, metric.replace("_", " "))


def is_rate(metric: str) -> bool:
    """Return whether a metric is a rate that is shown in percent."""
    name = _own_name(metric)
    return name in ("success_rate", "nerve_shown_rate") or bool(limits_among([name]))


def bounds_of(metric: str) -> tuple[float, float]:
    """Return the lowest and the highest value that a metric can have."""
    name = _own_name(metric)
    if is_rate(metric) or "dice" in name:
        return 0.0, 1.0
    if name in STEPS:
        return 1.0, math.inf
    return 0.0 if name in {each.metric for each in (*QUANTITIES, *OLDER)} else -math.inf, math.inf


def _own_name(metric: str) -> str:
    """Return the name of a metric without the prefix and suffix that say which episodes it is over."""
    return metric.rpartition("/")[2].removesuffix(NOT_STARTED_SOLVED)


def value_text(metric: str, value: float) -> str:
    """Return a value of a metric as tables show it: a share in percent, distances with one digit after the point."""
    form = "{:.1%}" if is_rate(metric) else "{:,.0f}" if abs(value) >= 1000 else FORMS.get(_own_name(metric), "{:.4g}")
    return formatted(form, value)


def interval_text(estimate: Estimate, form: str) -> str:
    """Return an interval such as `1.5–2.0`; empty if there is none."""
    if math.isnan(estimate.low):
        return ""
    low, high = (formatted(form, end).removesuffix("%") for end in estimate[1:])
    # A dash between numbers below zero would be read as another minus.
    return f"{low}{' to ' if estimate.low < 0 else '–'}{high}"

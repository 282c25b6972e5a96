"""The look of all charts, and how people call what they show."""

from __future__ import annotations

import functools

from plotly import io
from plotly.colors import qualitative
from plotly.graph_objs.layout import Template

from armscan.training.on_plane import limits_among
from armscan.training.result_table import QUANTITIES

# One hue for what a chart shows, another for what stands out, grey for the rest; Matplotlib's pictures have them, too.
BLUE, ORANGE, RED, GREY = "#1f77b4", "#ff7f0e", "#d62728", "#9a9a9a"
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
# Curves of more points are lines without markers.
MOST_MARKERS = 60


@functools.cache
def look() -> Template:
    """Return the template of all charts."""
    template = Template(io.templates["plotly_white"])
    template.layout.update(
        font={"family": "system-ui, sans-serif", "size": 13, "color": "#222"},
        colorway=qualitative.D3,
        hoverlabel={"align": "left"},
        margin={"t": 20, "r": 20, "b": 50, "l": 60},
        xaxis={"automargin": True},
        yaxis={"automargin": True},
    )
    return template


def title_of(metric: str) -> str:
    """Return how people call a metric, with its statistic and unit, such as `steps, mean`."""
    limits = limits_among([metric])
    return limits[0].title if limits else TITLES.get(metric, metric.replace("_", " "))


def is_rate(metric: str) -> bool:
    """Return whether a metric is a share of episodes."""
    return "success_rate" in metric or bool(limits_among([metric.rpartition("/")[2]]))


def value_text(metric: str, value: float) -> str:
    """Return a value of a metric as people read it: a share in percent, other numbers with four digits."""
    return f"{value:.1%}" if is_rate(metric) else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def mode(n_points: int) -> str:
    """Return how a curve of so many points is drawn: with its points, unless they would hide it."""
    return "lines+markers" if n_points <= MOST_MARKERS else "lines"

"""The style of all charts."""

from __future__ import annotations

import functools

from plotly import io
from plotly.colors import qualitative
from plotly.graph_objs.layout import Template

# One hue for what a chart shows, another for what stands out, grey for the rest; Matplotlib's charts use them, too.
BLUE, ORANGE, RED, GREY = "#1f77b4", "#ff7f0e", "#d62728", "#9a9a9a"
# No rate is below 0 % or above 100 %.
RATE_AXIS = {"tickformat": ".0%", "autorangeoptions": {"minallowed": -0.03, "maxallowed": 1.03}}
# Curves of more points are lines without markers.
MAX_MARKERS = 60


@functools.cache
def template() -> Template:
    """Return the template of all charts."""
    plain = Template(io.templates["plotly_white"])
    plain.layout.update(
        font={"family": "system-ui, sans-serif", "size": 13, "color": "#222"},
        colorway=qualitative.D3,
        hoverlabel={"align": "left"},
        margin={"t": 20, "r": 20, "b": 50, "l": 60},
        xaxis={"automargin": True},
        yaxis={"automargin": True},
    )
    return plain


def line_mode(n_points: int) -> str:
    """Return Plotly's mode for a curve of `n_points`: with markers, unless they would hide it."""
    return "lines+markers" if n_points <= MAX_MARKERS else "lines"

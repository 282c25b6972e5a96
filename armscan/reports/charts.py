"""The charts of a comparison."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

from plotly.colors import hex_to_rgb, qualitative
from plotly.graph_objects import Figure
from plotly.subplots import make_subplots

from armscan.reports.chart_style import GREY, RATE_AXIS, line_mode
from armscan.reports.curves import AXES, NOTHING, Curve
from armscan.reports.groups import Group
from armscan.reports.significance import evaluations_by_seed
from armscan.stats.aggregation import MIN_SEEDS
from armscan.stats.bootstrap import Estimate
from armscan.training import MetricEstimates
from armscan.training.metric_display import is_rate, title_of
from armscan.utils.text import counted

# By metric, axis and index of the group.
Curves = Mapping[tuple[str, str, int], Curve]

# More groups would hide each other behind their bands and seeds.
MANY = 6
ROW_PX, LEGEND_ROW_PX, GROUP_PX, LINE_PX, AROUND_PX, SWITCHES_PX = 250, 22, 34, 16, 110, 84
# Widths in the legend: all of it, one letter, and the line beside a name.
LEGEND_PX, LETTER_PX, SAMPLE_PX = 950, 7, 50
BANDS, SEEDS = "band", "seed"
# Traces shown beside the thick lines, by button.
SHOWN = {"bands and seeds": (BANDS, SEEDS), "bands": (BANDS,), "neither": ()}
LABEL_CHARS = 38
# Final metrics shown beside the leading rate.
FINAL = ("median_distance_mm", "mean_steps")
Points = dict[str, list[Any]]


@dataclass(frozen=True)
class Trace:
    """A line of a learning curve.

    Args:
        kind: One of `BANDS` and `SEEDS`, or empty for a trace of the whole group.
        look: Arguments of the line for Plotly.
        over: Points of the trace over each of `AXES`.
    """

    kind: str
    look: Mapping[str, Any]
    over: Sequence[Points]


def colours(n: int) -> list[str]:
    """Return a colour for each of `n` groups."""
    palette = qualitative.D3 if n <= len(qualitative.D3) else qualitative.Dark24
    return [str(palette[number % len(palette)]) for number in range(n)]


def learning_curves(groups: Sequence[Group], curves: Curves, titles: Mapping[str, str], *, is_detailed: bool) -> Figure:
    """Return metrics one below the other, with switches for the axis and for the lines of single seeds.

    Args:
        groups: Groups that are drawn.
        curves: Their curves.
        titles: Title of each metric, by its name.
        is_detailed: Whether bands and the lines of single seeds are drawn.
    """
    entry_px = SAMPLE_PX + LETTER_PX * max(len(group.label) for group in groups)
    legend_px = LEGEND_ROW_PX * math.ceil(len(groups) / max(1, LEGEND_PX // entry_px))
    shown = "bands and seeds" if len(groups) <= MANY else "neither"
    figure = make_subplots(rows=len(titles), cols=1, shared_xaxes=True, vertical_spacing=0.08 / len(titles))
    traces: list[Trace] = []
    for row, (name, title) in enumerate(titles.items(), start=1):
        for number, (group, colour) in enumerate(zip(groups, colours(len(groups)), strict=True)):
            of_axes = [curves.get((name, axis, number), NOTHING) for axis in AXES]
            for trace in _traces(of_axes, colour, is_detailed=is_detailed):
                figure.add_scatter(
                    **trace.look, **trace.over[0], name=group.label, legendgroup=str(number), row=row, col=1
                )
                traces.append(trace)
        figure.update_yaxes(title=title, row=row, col=1, **(RATE_AXIS if is_rate(name) else {}))
    named: set[str] = set()
    for drawn, trace in zip(figure.data, traces, strict=True):
        # The legend has one line for each group.
        drawn.showlegend = "text" in trace.over[0] and drawn.legendgroup not in named
        named |= {drawn.legendgroup} if drawn.showlegend else set()
        drawn.visible = trace.kind in ("", *SHOWN[shown])
    figure.update_xaxes(rangemode="tozero")
    figure.update_xaxes(title=next(iter(AXES)), row=len(titles), col=1)
    figure.update_layout(
        height=SWITCHES_PX + ROW_PX * len(titles) + AROUND_PX + legend_px,
        margin={"t": SWITCHES_PX, "b": AROUND_PX + legend_px, "l": 70, "r": 20, "autoexpand": False},
        legend={
            "orientation": "h",
            "entrywidth": entry_px,
            "x": 0,
            "y": -55 / (ROW_PX * len(titles)),
            "yanchor": "top",
        },
        updatemenus=[_axis_switch(traces, len(titles)), _kind_switch(traces, shown)],
    )
    return figure


def add_estimate(
    figure: Figure,
    label: str,
    colour: str,
    estimate: Estimate,
    scores: Mapping[str, float],
    hover: str,
    name: str = "",
    **where: int,
) -> None:
    """Add an estimate with its interval to a chart, and a dot for each seed.

    Args:
        figure: Chart to add to.
        label: Its place on the vertical axis.
        colour: Colour of the estimate and the dots.
        estimate: Estimate to add.
        scores: Score of each seed, by its name.
        hover: Plotly's template of the text beside the pointer.
        name: Text in the box behind the score of a seed. Default: none.
        **where: Row and column of a subplot.
    """
    value, low, high = estimate
    of_both = {"mode": "markers", "showlegend": False, **where}
    figure.add_scatter(
        x=list(scores.values()),
        y=[label] * len(scores),
        text=list(scores),
        hovertemplate=f"%{{text}}: %{{x}}<extra>{name}</extra>",
        marker={"color": colour, "opacity": 0.45, "size": 9},
        **of_both,
    )
    figure.add_scatter(
        x=[value],
        y=[label],
        hovertemplate=hover,
        error_x={"type": "data", "symmetric": False, "array": [high - value], "arrayminus": [value - low]},
        marker={"color": colour, "size": 12, "symbol": "diamond"},
        **of_both,
    )


def final_chart(
    groups: Sequence[Group], reached: Sequence[MetricEstimates | None], baselines: Mapping[str, MetricEstimates]
) -> Figure:
    """Return a chart of each group's final figures, with the interval and the single seeds, and of the baselines.

    Args:
        groups: Groups that are drawn.
        reached: Final figures of each; None without a final evaluation.
        baselines: Figures of the baselines, by their names.
    """
    limits = next(figures.on_plane[0] for figures in reached if figures is not None)
    titles = {limits.metric: limits.title} | {name: title_of(name) for name in FINAL}
    rows: list[tuple[str, str, MetricEstimates | None, dict[str, dict[str, float]]]] = []
    for group, colour, figures in zip(groups, colours(len(groups)), reached, strict=True):
        of_seeds = {f"seed {seed}": each.metrics() for seed, each in evaluations_by_seed(group).items()}
        rows.append((_wrapped(group.label), colour, figures, of_seeds))
    rows += [(_wrapped(name), GREY, figures, {}) for name, figures in baselines.items()]
    figure = make_subplots(rows=1, cols=len(titles), shared_yaxes=True, horizontal_spacing=0.04)
    for column, (name, title) in enumerate(titles.items(), start=1):
        for label, colour, figures, metrics in rows:
            if figures is None or name not in figures.estimates:
                continue
            estimate = figures.estimate(name)
            seeds = {seed: of_seed[name] for seed, of_seed in metrics.items() if name in of_seed}
            hover = f"%{{x}} ({estimate.low:.3g} to {estimate.high:.3g})<extra></extra>"
            add_estimate(figure, label, colour, estimate, seeds, hover, row=1, col=column)
        figure.update_xaxes(title=title, row=1, col=column, **(RATE_AXIS if is_rate(name) else {}))
    figure.update_yaxes(autorange="reversed", automargin=True)
    # The rows are equally high.
    n_lines = max(label.count("<br>") + 1 for label, *_ in rows)
    height = AROUND_PX + max(GROUP_PX, LINE_PX * n_lines + LINE_PX // 2) * len(rows)
    return figure.update_layout(height=height, margin={"t": 20, "b": 50, "l": 10, "r": 20})


def _traces(of_axes: Sequence[Curve], colour: str, *, is_detailed: bool) -> Iterator[Trace]:
    """Yield the band, the lines of the seeds, and the line of their mean."""
    curve = of_axes[0]
    if curve.n_seeds > 1 and is_detailed:
        if curve.n_seeds >= MIN_SEEDS:
            unseen = {"mode": "lines", "line": {"width": 0}, "hoverinfo": "skip"}
            faint = "rgba({}, {}, {}, 0.2)".format(*hex_to_rgb(colour))
            yield Trace(BANDS, unseen, [_points(each.places, each.band.lows) for each in of_axes])
            filled = unseen | {"fill": "tonexty", "fillcolor": faint}
            yield Trace(BANDS, filled, [_points(each.places, each.band.highs) for each in of_axes])
        thin = {"line": {"color": colour, "width": 1}, "opacity": 0.5}
        for label, (places, _) in curve.lines.items():
            said = {"mode": "lines" if len(places) > 1 else "lines+markers", "hovertemplate": f"%{{y:.3g}} ({label})"}
            yield Trace(SEEDS, thin | said, [_points(*each.lines.get(label, ((), ()))) for each in of_axes])
    if curve.n_seeds:
        thick = {
            "mode": line_mode(len(curve.places)),
            "marker": {"size": 5},
            "line": {"color": colour, "width": 2.5},
            "hovertemplate": "%{text}",
        }
        yield Trace("", thick, [_points(each.places, each.band.values) | {"text": _said(each)} for each in of_axes])


def _points(places: Iterable[float], values: Iterable[float]) -> Points:
    return {"x": [float(place) for place in places], "y": [float(value) for value in values]}


def _said(curve: Curve) -> list[str]:
    """Return the hover text of each point of a curve."""
    if curve.n_seeds < MIN_SEEDS:
        n_seeds = counted(curve.n_seeds, "seed")
        return [f"{value:.3g} ({n_seeds})" for value in curve.band.values]
    return [f"{value:.3g} ({low:.3g} to {high:.3g})" for value, low, high in zip(*curve.band, strict=True)]


def _wrapped(label: str) -> str:
    return "<br>".join(wrap(label, LABEL_CHARS))


def _axis_switch(traces: Sequence[Trace], n_rows: int) -> dict[str, Any]:
    """Return buttons that draw the same lines over another axis."""
    last = f"xaxis{n_rows if n_rows > 1 else ''}"
    buttons = []
    for number, axis in enumerate(AXES):
        points = {key: [trace.over[number].get(key) for trace in traces] for key in ("x", "y", "text")}
        scale = {f"xaxis{row if row > 1 else ''}.autorange": True for row in range(1, n_rows + 1)}
        changes: list[Any] = [points, scale | {f"{last}.title.text": axis}]
        buttons.append({"label": f"by {axis}", "method": "update", "args": changes})
    return _switch(buttons, active=0, below_px=44)


def _kind_switch(traces: Sequence[Trace], shown: str) -> dict[str, Any]:
    """Return buttons that show and hide bands and the lines of single seeds."""
    numbers = [number for number, trace in enumerate(traces) if trace.kind]
    buttons = []
    for label, kinds in SHOWN.items():
        visible = [traces[number].kind in kinds for number in numbers]
        buttons.append({"label": label, "method": "restyle", "args": [{"visible": visible}, numbers]})
    return _switch(buttons, active=list(SHOWN).index(shown), below_px=6) | {"visible": bool(numbers)}


def _switch(buttons: Sequence[dict[str, Any]], *, active: int, below_px: int) -> dict[str, Any]:
    where = {"x": 0, "xanchor": "left", "y": 1.0, "yanchor": "bottom", "pad": {"b": below_px}, "font": {"size": 11}}
    return {"type": "buttons", "direction": "right", "active": active, "buttons": list(buttons), **where}

"""The charts of a study's report."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from optuna.visualization import plot_parallel_coordinate, plot_pareto_front
from plotly.graph_objects import Figure, Scatter

from armscan.reports.chart_style import BLUE, GREY, ORANGE, RATE_AXIS, RED, line_mode
from armscan.reports.html import chart
from armscan.sweeps.results.csv_tables import study_of_one_objective
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.scheduling.state import comparable_trials, is_feasible
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.reports import reports_of
from armscan.training.metric_display import is_rate, title_of
from armscan.utils.text import counted

HEIGHT_PX, SMALL_PX, BAR_PX = 360, 260, 34
MAX_TICKS = 20
# Trials from which on importances say something.
ENOUGH = 50
# Room on either side of a range, as a share of it.
MARGIN = 0.03
LEGEND = {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0}


def charts_of(
    study: optuna.Study, trials: Sequence[FrozenTrial], objectives: Sequence[str], shares: Sequence[Mapping[str, Any]]
) -> Iterator[str]:
    """Yield the charts of a study with their headings, as HTML.

    Args:
        study: Study to draw.
        trials: All of its trials.
        objectives: Names of the metrics that are its values, in order.
        shares: Importance of each key by objective; empty if too few trials have finished.
    """
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    if any(map(reports_of, trials)):
        for number, objective in enumerate(objectives):
            heading = f"While training: {html.escape(title_of(objective))}"
            yield _titled(
                heading, _reports(trials, number, objective), "A line for each trial, seeds one after another."
            )
    if not complete:
        yield "<p>No trial has run to its end yet.</p>"
        return
    violating = "" if all(map(is_feasible, complete)) else "trials that violate a constraint."
    # Optuna draws a front of two or three objectives.
    if len(objectives) in (2, 3):
        figure = plot_pareto_front(study, target_names=list(map(title_of, objectives)))
        said = "Red: trials that no other dominates. Blue: the other completed trials."
        said += f" Grey: {violating}" if violating else ""
        yield _titled("Pareto front", figure.update_layout(height=HEIGHT_PX), said)
    for number, (objective, direction) in enumerate(zip(objectives, study.directions, strict=True)):
        title = html.escape(title_of(objective))
        better = "Higher" if direction == StudyDirection.MAXIMIZE else "Lower"
        yield _titled(f"History: {title}", _history(complete, number, objective, direction), f"{better} is better.")
        if rows := [row for row in shares if row["objective"] == objective]:
            n_trials = len(comparable_trials(complete))
            yield _titled(f"Importance of each key: {title}", _importance(rows), _on_importance(n_trials))
        keys = list(dict.fromkeys(key for trial in complete for key in trial.params))
        drawn = "".join(chart(_slice(complete, key, number, objective)) for key in keys)
        said = f"<p>Grey: {violating}</p>" if violating else ""
        yield f'<h2>Slices of the space: {title}</h2>{said}<div class="charts">{drawn}</div>'
        figure = plot_parallel_coordinate(
            study_of_one_objective(complete, number, direction), target_name=title_of(objective)
        )
        # The scale ends in white.
        figure.update_layout(height=HEIGHT_PX, plot_bgcolor="#d0d0d0")
        said = f"Darker is better.{f' Dotted: {violating}' if violating else ''}"
        yield f"<h2>Parallel coordinates: {title}</h2><p>{said}</p>{chart(figure, is_wide=True)}"


def _on_importance(n_trials: int) -> str:
    said = (
        "How much each key sets the best tenth of the trials apart from all trials (PED-ANOVA), as a share of all "
        "keys, among trials that violate no constraint. A key that only tells bad trials from worse ones gets little."
    )
    return said + (f" {counted(n_trials, 'trial')} say little: some fifty are required." if n_trials < ENOUGH else "")


def _titled(heading: str, figure: Figure, said: str = "") -> str:
    return f"<h2>{heading}</h2>{f'<p>{said}</p>' if said else ''}{chart(figure)}"


def _value(number: int) -> Callable[[FrozenTrial], float]:
    return lambda trial: float(trial.values[number])


def _axis(metric: str) -> dict[str, Any]:
    """Return the layout of a metric's axis."""
    return {"title": title_of(metric)} | (RATE_AXIS if is_rate(metric) else {})


def _hover(trials: Sequence[FrozenTrial]) -> dict[str, Any]:
    """Return the hover text of trials: value, number and settings."""
    said = [
        "<br>".join(map(html.escape, (f"trial {trial.number}", *overrides_of(searched_values(trial)))))
        for trial in trials
    ]
    return {"text": said, "hovertemplate": "%{y:.4g}<br>%{text}<extra></extra>"}


def _history(trials: Sequence[FrozenTrial], number: int, objective: str, direction: StudyDirection) -> Figure:
    """Return the values of the trials in order, and the best so far among feasible ones."""
    figure = Figure()
    for name, color, wants_feasible in (("trial", BLUE, True), ("infeasible trial", GREY, False)):
        drawn = [trial for trial in trials if is_feasible(trial) == wants_feasible]
        hover = _hover(drawn)
        points: dict[str, Any] = {"mode": "markers", "marker": {"color": color, "size": 7, "opacity": 0.7}}
        numbers, values = [trial.number for trial in drawn], list(map(_value(number), drawn))
        if drawn:
            figure.add_scatter(x=numbers, y=values, name=name, **points, **hover)
    axis = {"title": "trial", "tick0": 0, "dtick": 1 + trials[-1].number // MAX_TICKS}
    feasible = list(filter(is_feasible, trials))
    numbers, values = [trial.number for trial in feasible], list(map(_value(number), feasible))
    best = list(accumulate(values, max if direction == StudyDirection.MAXIMIZE else min))
    line = {"color": ORANGE, "width": 2, "shape": "hv"}
    figure.add_scatter(x=numbers, y=best, mode=line_mode(len(best)), line=line, marker={"size": 4}, name="best so far")
    return figure.update_layout(height=HEIGHT_PX, xaxis=axis, yaxis=_axis(objective), legend=LEGEND)


def _importance(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Return the importance of each key as bars, the most important on top."""
    figure = Figure()
    bar = {
        "orientation": "h",
        "marker": {"color": BLUE},
        "texttemplate": "%{x:.0%}",
        "textposition": "auto",
        "textangle": 0,
    }
    figure.add_bar(x=[row["importance"] for row in rows], y=[row["key"] for row in rows], **bar)
    figure.update_yaxes(autorange="reversed").update_xaxes(rangemode="tozero", tickformat=".0%")
    return figure.update_layout(height=90 + BAR_PX * len(rows))


def _slice(trials: Sequence[FrozenTrial], key: str, number: int, objective: str) -> Figure:
    """Return the values of the trials by one key."""
    having = [trial for trial in trials if key in trial.params]
    found = having[0].distributions[key]
    is_choice = isinstance(found, CategoricalDistribution)
    places = [str(trial.params[key]) if is_choice else trial.params[key] for trial in having]
    hover = _hover(having)
    colours = [BLUE if is_feasible(trial) else GREY for trial in having]
    points = {"mode": "markers", "marker": {"color": colours, "size": 7, "opacity": 0.5}}
    figure = Figure(Scatter(x=places, y=[_value(number)(trial) for trial in having], **points, **hover))
    return figure.update_layout(height=SMALL_PX, xaxis=key_axis(key, found), yaxis=_axis(objective))


def key_axis(key: str, distribution: BaseDistribution) -> dict[str, Any]:
    """Return the layout of a searched key's axis: its whole range, or all of its choices."""
    if isinstance(distribution, CategoricalDistribution):
        choices = list(map(str, distribution.choices))
        return {"title": key, "type": "category", "categoryorder": "array", "categoryarray": choices}
    limits: Any = distribution
    ends = (math.log10(limits.low), math.log10(limits.high)) if limits.log else (limits.low, limits.high)
    # Room for the markers at both ends.
    margin = MARGIN * (ends[1] - ends[0])
    # Of less than two decades, powers of ten alone would be few: 1, 2 and 5 are labelled.
    ticks = {"dtick": "D2"} if ends[1] - ends[0] < 2 else {"dtick": 1, "exponentformat": "power"}
    how = {"type": "log", **ticks} if limits.log else {}
    return {"title": key, "range": [ends[0] - margin, ends[1] + margin], **how}


def _reports(trials: Sequence[FrozenTrial], number: int, objective: str) -> Figure:
    """Return a chart of the trials' reports: finished trials grey, pruned ones ending in a cross, running ones blue."""
    figure, named = Figure(), set()
    looks: dict[TrialState, tuple[str, dict[str, Any]]] = {
        TrialState.COMPLETE: ("finished", {"line": {"color": GREY, "width": 1}, "opacity": 0.6}),
        TrialState.PRUNED: ("pruned", {"line": {"color": RED, "width": 1}, "opacity": 0.6}),
        TrialState.RUNNING: ("running", {"line": {"color": BLUE, "width": 2.5}}),
    }
    for trial in sorted(trials, key=lambda trial: trial.state == TrialState.RUNNING):
        points = [(step, values[number]) for step, values in reports_of(trial).items()]
        if not points:
            continue
        name, style = looks.get(trial.state, ("failed", {"line": {"color": GREY, "width": 1, "dash": "dot"}}))
        symbols = ["circle"] * (len(points) - 1) + ["x" if trial.state == TrialState.PRUNED else "circle"]
        sizes = [5] * (len(points) - 1) + [8 if trial.state == TrialState.PRUNED else 6]
        figure.add_scatter(
            x=[step for step, _ in points],
            y=[value for _, value in points],
            mode=line_mode(len(points)),
            marker={"symbol": symbols, "size": sizes},
            name=name,
            legendgroup=name,
            showlegend=name not in named,
            hovertemplate=f"trial {trial.number}: %{{y:.4g}}<extra>{name}</extra>",
            **style,
        )
        named.add(name)
    axes = {"xaxis_title": "environment steps, of all seeds", "yaxis": _axis(objective)}
    return figure.update_layout(height=HEIGHT_PX, legend=LEGEND, **axes)

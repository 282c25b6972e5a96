"""Charts of a population: who continued from whom, and how the values of each member changed."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from optuna.trial import FrozenTrial, TrialState
from plotly.graph_objects import Figure

from armscan.agents.schedule import FROM
from armscan.reports.chart_style import BLUE, GREY, ORANGE
from armscan.reports.html import chart
from armscan.sweeps.results.charts import HEIGHT_PX, SMALL_PX, key_axis
from armscan.sweeps.scheduling.population import lineage
from armscan.sweeps.storage.attribute_names import GENERATION, INTERVAL, MEMBER, PARENT, SCHEDULE
from armscan.training.metric_display import title_of

STEPS = "environment steps"


def population_charts(trials: Sequence[FrozenTrial], objective: str, best: FrozenTrial | None) -> Iterator[str]:
    """Yield the charts of a population with their headings, as HTML; nothing for a study of independent trials.

    Args:
        trials: All trials of the study.
        objective: Name of its objective.
        best: Best trial of the latest generation; None before the first has finished.
    """
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE and GENERATION in trial.user_attrs]
    if not complete or best is None:
        return
    ancestors = list(lineage(trials, best))
    said = "A point for each trial, a line from the trial that it continued from; orange: those that led to the best."
    heading, tree = html.escape(title_of(objective)), chart(_tree(complete, ancestors, objective))
    yield f"<h2>Population: {heading}</h2><p>{said}</p>{tree}"
    newest: dict[int, FrozenTrial] = {}
    for trial in sorted(complete, key=lambda each: int(each.user_attrs[GENERATION])):
        newest[trial.user_attrs[MEMBER]] = trial
    drawn = "".join(chart(_values(list(newest.values()), best, key)) for key in best.params)
    said = "A line for each member, through the members that it continued from; orange: the best."
    yield f'<h2>Schedules</h2><p>{said}</p><div class="charts">{drawn}</div>'


def _tree(complete: Sequence[FrozenTrial], ancestors: Sequence[FrozenTrial], objective: str) -> Figure:
    of_number = {trial.number: trial for trial in complete}
    figure = Figure()
    x: list[float | None] = []
    y: list[float | None] = []
    for trial in complete:
        if (parent := of_number.get(trial.user_attrs.get(PARENT, -1))) is not None:
            x += [_end(parent), _end(trial), None]
            y += [parent.values[0], trial.values[0], None]
    plain: Mapping[str, Any] = {"hoverinfo": "skip", "showlegend": False, "mode": "lines"}
    figure.add_scatter(x=x, y=y, line={"color": GREY, "width": 1}, **plain)
    for before, after in pairwise(ancestors):
        line = {"color": ORANGE, "width": 2.5}
        figure.add_scatter(x=[_end(before), _end(after)], y=[before.values[0], after.values[0]], line=line, **plain)
    figure.add_scatter(
        x=[_end(trial) for trial in complete],
        y=[trial.values[0] for trial in complete],
        mode="markers",
        marker={"color": BLUE, "size": 7},
        text=[f"trial {trial.number}, member {trial.user_attrs[MEMBER]}" for trial in complete],
        hovertemplate="%{text}: %{y:.4g}<extra></extra>",
        showlegend=False,
    )
    return figure.update_layout(height=HEIGHT_PX, xaxis_title=STEPS, yaxis_title=title_of(objective))


def _values(members: Sequence[FrozenTrial], best: FrozenTrial, key: str) -> Figure:
    """Return the values of a key in the course of each member's training."""
    figure = Figure()
    for trial in sorted(members, key=lambda each: each.number == best.number):
        segments = [segment for segment in trial.user_attrs[SCHEDULE] if key in segment]
        look = {"color": ORANGE, "width": 3} if trial.number == best.number else {"color": GREY, "width": 1}
        figure.add_scatter(
            x=[*(segment[FROM] for segment in segments), _end(trial)],
            y=[*(segment[key] for segment in segments), segments[-1][key]],
            mode="lines",
            line={**look, "shape": "hv"},
            showlegend=False,
            hovertemplate=f"member {trial.user_attrs[MEMBER]}: %{{y:.4g}}<extra></extra>",
        )
    return figure.update_layout(height=SMALL_PX, xaxis_title=STEPS, yaxis=key_axis(key, best.distributions[key]))


def _end(trial: FrozenTrial) -> int:
    return int(trial.user_attrs[INTERVAL][1])

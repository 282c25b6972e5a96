"""The charts in the report of a study: its course, and what its objectives depend on."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import optuna
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from optuna.visualization import (
    plot_intermediate_values,
    plot_optimization_history,
    plot_parallel_coordinate,
    plot_pareto_front,
    plot_slice,
)
from plotly import graph_objects

from armscan.reports.html import chart

MIN_TRIALS_FOR_IMPORTANCE = 4


def importances(study: optuna.Study, objectives: Sequence[str]) -> list[dict[str, Any]]:
    """Return a row for each objective and key: which share of the differences between trials the key explains.

    By PED-ANOVA (Watanabe et al. 2023, arXiv:2304.10255). None where too few trials have run to their end.
    """
    if len(_finished(study)) < MIN_TRIALS_FOR_IMPORTANCE:
        return []
    rows = []
    for number, (objective, direction) in enumerate(zip(objectives, study.directions, strict=True)):
        # Low is good for the evaluator.
        sign = -1.0 if direction == StudyDirection.MAXIMIZE else 1.0
        target = _value(number, sign) if len(objectives) > 1 else None
        with warnings.catch_warnings():
            # That low is good.
            warnings.simplefilter("ignore")
            shares = get_param_importances(study, evaluator=PedAnovaImportanceEvaluator(), target=target)
        rows += [{"objective": objective, "key": key, "importance": share} for key, share in shares.items()]
    return rows


def charts(study: optuna.Study, objectives: Sequence[str], shares: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the charts of a study with their headings, as HTML.

    Args:
        study: in its storage.
        objectives: the names of its values.
        shares: see `importances`.
    """
    if not _finished(study):
        return ["<p>No trial has run to its end yet.</p>"]
    drawn = _charts(study, objectives, shares)
    return [f"<h2>{heading}</h2>{chart(figure)}" for heading, figure in drawn]


def _charts(
    study: optuna.Study, objectives: Sequence[str], shares: Sequence[Mapping[str, Any]]
) -> Iterator[tuple[str, graph_objects.Figure]]:
    if len(objectives) > 1:
        yield "Trials that no other is better than", plot_pareto_front(study, target_names=list(objectives))
    for number, objective in enumerate(objectives):
        several = f": {objective}" if len(objectives) > 1 else ""
        of_this: dict[str, Any] = {"target": _value(number), "target_name": objective}
        yield f"History{several}", plot_optimization_history(study, **of_this)
        if bars := [row for row in shares if row["objective"] == objective]:
            yield f"Importance of each key{several}", _bars(bars)
        yield f"Parallel coordinates{several}", plot_parallel_coordinate(study, **of_this)
        yield f"Slices of the space{several}", plot_slice(study, **of_this)
    if len(objectives) == 1:
        yield "Reports while training, pruned trials too", plot_intermediate_values(study)


def _finished(study: optuna.Study) -> list[FrozenTrial]:
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))


def _value(number: int, sign: float = 1.0) -> Callable[[FrozenTrial], float]:
    return lambda trial: sign * trial.values[number]


def _bars(rows: Sequence[Mapping[str, Any]]) -> graph_objects.Figure:
    shares, keys = [row["importance"] for row in rows], [row["key"] for row in rows]
    return graph_objects.Figure(graph_objects.Bar(x=shares, y=keys, orientation="h"))

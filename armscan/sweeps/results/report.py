"""The report of a study: one HTML file that needs no server, and every number of it as CSV beside it."""

from __future__ import annotations

import html
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
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

from armscan.reports.html import chart, table, video_address, write_page
from armscan.sweeps.results.summary import ConfigResult, final_results, final_table, values_of
from armscan.sweeps.scheduling.state import ENV_STEPS, FAILURE, FINALIST, METRICS, RETRIED, RETRY_OF, StudyState
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.study.study import best_trials
from armscan.sweeps.tasks.attempt import FOLDER, RUN

MIN_TRIALS_FOR_IMPORTANCE = 4


def write_report(study: optuna.Study, final_trials: Sequence[FrozenTrial], folder: Path) -> Path:
    """Write the report of a study.

    Args:
        study: in its storage.
        final_trials: those of the final evaluation; empty without one.
        folder: takes `report.html` and the CSV files.

    Returns:
        The HTML file.
    """
    objectives = list(study.user_attrs["objectives"])
    trials, found = study.get_trials(deepcopy=False), final_results(final_trials)
    tables = {
        "trials": [_trial_row(trial, objectives) for trial in trials],
        "reports": [
            {"trial": trial.number, "step": step, "value": value}
            for trial in trials
            for step, value in trial.intermediate_values.items()
        ],
        "endings": _endings(trials),
        "failures": [
            {"trial": trial.number, "cause": _cause(trial), "values": " ".join(overrides_of(trial.params))}
            for trial in trials
            if trial.state == TrialState.FAIL
        ],
        "result": list(_result_rows(found)),
        "importances": _importances(study, objectives),
    }
    parts = [
        _summary(study, trials, objectives),
        "<h2>Result</h2><p>The best settings, trained with new seeds, on the test volumes, beside the baselines.</p>",
        _result(found, trials) if found else "<p>No final evaluation yet.</p>",
        _videos(final_trials),
        *_charts(study, objectives, tables["importances"]),
        "<h2>How trials have ended</h2>",
        table(tables["endings"]) if trials else "<p>No trial has been begun.</p>",
        "<h2>Failures</h2>",
        table(tables["failures"]) if tables["failures"] else "<p>No trial has failed.</p>",
    ]
    return write_page(folder, f"Study {study.study_name}", parts, tables)


def _summary(study: optuna.Study, trials: Sequence[FrozenTrial], objectives: Sequence[str]) -> str:
    state, best = StudyState.of(trials), best_trials(study, 1)
    n_pruned = sum(trial.state == TrialState.PRUNED for trial in state.finished)
    text = (
        f"{len(state.finished)} trials finished, {n_pruned} of them pruned; {len(state.failed)} failed, "
        f"{len(state.retried)} retried after their worker died. {state.env_steps:,} environment steps, "
        f"{state.busy_hours:.2f} hours."
    )
    if best:
        found = html.escape(values_of(best[0], objectives))
        text += f" Best in the search: trial {best[0].number}, {found} (optimistically biased)."
    return f"<p>{text}</p>"


def _videos(final_trials: Sequence[FrozenTrial]) -> str:
    """Return a video of each finally evaluated configuration, of its first training that has one here."""
    films: dict[int, str] = {}
    for trial in final_trials:
        files = sorted(Path(trial.user_attrs.get(FOLDER, "nowhere")).glob("seed_*/episode.gif"))
        if files and trial.user_attrs[FINALIST] not in films:
            address = video_address(files[0].read_bytes())
            films[trial.user_attrs[FINALIST]] = f'<img alt="an episode" src="{address}">'
    return "".join(f"<h3>Trial {number}: an episode on a test volume</h3>{film}" for number, film in films.items())


def _trial_row(trial: FrozenTrial, objectives: Sequence[str]) -> dict[str, Any]:
    values = dict(zip(objectives, trial.values or (), strict=False)) if trial.state == TrialState.COMPLETE else {}
    seconds = trial.duration.total_seconds() if trial.duration is not None else None
    metrics = {f"figure/{name}": value for name, value in trial.user_attrs.get(METRICS, {}).items()}
    return {
        "trial": trial.number,
        "state": trial.state.name.lower(),
        **values,
        "seconds": seconds,
        "env_steps": trial.user_attrs.get(ENV_STEPS),
        "retry_of": trial.user_attrs.get(RETRY_OF),
        "mlflow_run": trial.user_attrs.get(RUN),
        **trial.params,
        **metrics,
    }


def _endings(trials: Sequence[FrozenTrial]) -> list[dict[str, Any]]:
    """Return how many trials have ended in each way, and for which cause."""
    of_ending: dict[tuple[str, str], list[int]] = {}
    for trial in trials:
        cause = ""
        if trial.state == TrialState.FAIL:
            cause = _cause(trial) + (", retried" if RETRIED in trial.user_attrs else "")
        elif trial.state == TrialState.PRUNED:
            cause = f"behind the others at environment step {trial.last_step}"
        of_ending.setdefault((trial.state.name.lower(), cause), []).append(trial.number)
    return [
        {"ending": ending, "cause": cause, "trials": len(numbers), "which": " ".join(map(str, numbers))}
        for (ending, cause), numbers in sorted(of_ending.items())
    ]


def _cause(trial: FrozenTrial) -> str:
    return str(trial.user_attrs.get(FAILURE, "not known"))


def _result(found: Sequence[ConfigResult], trials: Sequence[FrozenTrial]) -> str:
    """Return the table of the result, and the settings of each trial in it."""
    values = {result.number: html.escape(" ".join(overrides_of(trials[result.number].params))) for result in found}
    items = "".join(f"<li>trial {number}: <code>{text}</code></li>" for number, text in values.items())
    return f"{final_table(found).html()}<ul>{items}</ul>"


def _result_rows(found: Sequence[ConfigResult]) -> Iterator[dict[str, Any]]:
    """Yield every figure of the result, also those of the baselines."""
    for result in found:
        for of, figures in {"agent": result.figures, **result.baselines}.items():
            for name, (value, low, high) in figures.estimates.items():
                row = {"trial": result.number, "of": of, "seeds": figures.n_seeds, "figure": f"test/{name}"}
                yield row | {"value": value, "low": low, "high": high}


def _importances(study: optuna.Study, objectives: Sequence[str]) -> list[dict[str, Any]]:
    """Return which share of the differences between trials each key explains; none where too few have finished."""
    # PED-ANOVA: Watanabe et al. 2023, arXiv:2304.10255.
    rows: list[dict[str, Any]] = []
    if len(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))) < MIN_TRIALS_FOR_IMPORTANCE:
        return rows
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


def _charts(study: optuna.Study, objectives: Sequence[str], shares: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the charts with their headings, as HTML."""
    if not study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
        yield "<p>No trial has run to its end yet.</p>"
        return
    if len(objectives) > 1:
        figure = plot_pareto_front(study, target_names=list(objectives))
        yield _titled("Trials that no other is better than", figure)
    for number, objective in enumerate(objectives):
        several = f": {objective}" if len(objectives) > 1 else ""
        of_this: dict[str, Any] = {"target": _value(number), "target_name": objective}
        yield _titled(f"History{several}", plot_optimization_history(study, **of_this))
        if rows := [row for row in shares if row["objective"] == objective]:
            bars = graph_objects.Bar(
                x=[row["importance"] for row in rows], y=[row["key"] for row in rows], orientation="h"
            )
            yield _titled(f"Importance of each key{several}", graph_objects.Figure(bars))
        yield _titled(f"Parallel coordinates{several}", plot_parallel_coordinate(study, **of_this))
        yield _titled(f"Slices of the space{several}", plot_slice(study, **of_this))
    if len(objectives) == 1:
        yield _titled("Reports while training, pruned trials too", plot_intermediate_values(study))


def _titled(heading: str, figure: graph_objects.Figure) -> str:
    return f"<h2>{heading}</h2>{chart(figure)}"


def _value(number: int, sign: float = 1.0) -> Callable[[FrozenTrial], float]:
    return lambda trial: sign * trial.values[number]

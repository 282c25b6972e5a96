"""The report of a study: one HTML file that needs no server, and every number of it as CSV beside it."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from armscan.reports.page import film_address, table, write_page
from armscan.sweeps.attempt import FOLDER, RUN
from armscan.sweeps.charts import charts, importances
from armscan.sweeps.judging import best_trials
from armscan.sweeps.tally import ENV_STEPS, FAILURE, FIGURES, JUDGED, RETRIED, RETRY_OF, Tally
from armscan.sweeps.values import overrides_of
from armscan.sweeps.verdict import Verdict, shown_of, verdicts


def write_report(study: optuna.Study, judged: Sequence[FrozenTrial], folder: Path) -> Path:
    """Writes the report of a study.

    Args:
        study: in its storage.
        judged: the trials of the study that judges; none where there is none.
        folder: takes `report.html` and the CSV files.

    Returns:
        The HTML file.
    """
    objectives = list(study.user_attrs["objectives"])
    trials, found = study.get_trials(deepcopy=False), verdicts(judged)
    tables = {
        "trials": [_trial_row(trial, objectives) for trial in trials],
        "reports": [
            {"trial": trial.number, "step": step, "value": value}
            for trial in trials
            for step, value in trial.intermediate_values.items()
        ],
        "endings": _endings(trials),
        "failures": [_failure_row(trial) for trial in trials if trial.state == TrialState.FAIL],
        "result": [row for verdict in found for row in _verdict_rows(verdict)],
        "importances": importances(study, objectives),
    }
    parts = [
        _summary(study, trials, objectives),
        "<h2>Result</h2><p>The best settings with seeds that chose nothing, on the test volumes: "
        "interquartile means over seeds and volumes, of success rates means, and 95 % intervals.</p>",
        table(_result_rows(found, trials)) if found else "<p>Nothing has been judged yet.</p>",
        _films(judged),
        *charts(study, objectives, tables["importances"]),
        "<h2>How trials have ended</h2>",
        table(tables["endings"]) if trials else "<p>No trial has been begun.</p>",
        "<h2>Failures</h2>",
        table(tables["failures"]) if tables["failures"] else "<p>No trial has failed.</p>",
    ]
    return write_page(folder, f"Study {study.study_name}", parts, tables)


def _summary(study: optuna.Study, trials: Sequence[FrozenTrial], objectives: Sequence[str]) -> str:
    tally = Tally.of(trials)
    n_pruned = sum(trial.state == TrialState.PRUNED for trial in tally.finished)
    best = best_trials(study, 1)
    found = (
        ", ".join(f"{name} {value:.4g}" for name, value in zip(objectives, best[0].values, strict=True)) if best else ""
    )
    return (
        f"<p>{len(tally.finished)} trials finished, {n_pruned} of them pruned; {len(tally.failed)} failed, "
        f"{len(tally.retried)} taken up again after their worker died. {tally.env_steps:,} environment steps, "
        f"{tally.busy_hours:.2f} hours."
        + (f" Best while searching: trial {best[0].number}, {html.escape(found)}; that flatters it." if best else "")
        + "</p>"
    )


def _films(judged: Sequence[FrozenTrial]) -> str:
    """Returns a film of each configuration that was judged, of its first training that left one here."""
    films: dict[int, str] = {}
    for trial in judged:
        files = sorted(Path(trial.user_attrs.get(FOLDER, "nowhere")).glob("seed_*/episode.gif"))
        if files and trial.user_attrs[JUDGED] not in films:
            address = film_address(files[0].read_bytes())
            films[trial.user_attrs[JUDGED]] = f'<img alt="an episode" src="{address}">'
    return "".join(f"<h3>Trial {number}: an episode on a test volume</h3>{film}" for number, film in films.items())


def _trial_row(trial: FrozenTrial, objectives: Sequence[str]) -> dict[str, Any]:
    values = dict(zip(objectives, trial.values or (), strict=False)) if trial.state == TrialState.COMPLETE else {}
    seconds = trial.duration.total_seconds() if trial.duration is not None else None
    told = {f"figure/{name}": value for name, value in trial.user_attrs.get(FIGURES, {}).items()}
    return {
        "trial": trial.number,
        "state": trial.state.name.lower(),
        **values,
        "seconds": seconds,
        "env_steps": trial.user_attrs.get(ENV_STEPS),
        "retry_of": trial.user_attrs.get(RETRY_OF),
        "mlflow_run": trial.user_attrs.get(RUN),
        **trial.params,
        **told,
    }


def _endings(trials: Sequence[FrozenTrial]) -> list[dict[str, Any]]:
    """Returns how many trials have ended in each way, and for which cause."""
    of_ending: dict[tuple[str, str], list[int]] = {}
    for trial in trials:
        cause = ""
        if trial.state == TrialState.FAIL:
            cause = str(trial.user_attrs.get(FAILURE, "not known")) + (
                ", taken up again" if RETRIED in trial.user_attrs else ""
            )
        elif trial.state == TrialState.PRUNED:
            cause = f"behind the others at environment step {trial.last_step}"
        of_ending.setdefault((trial.state.name.lower(), cause), []).append(trial.number)
    return [
        {"ending": ending, "cause": cause, "trials": len(numbers), "which": " ".join(map(str, numbers))}
        for (ending, cause), numbers in sorted(of_ending.items())
    ]


def _failure_row(trial: FrozenTrial) -> dict[str, Any]:
    return {
        "trial": trial.number,
        "cause": trial.user_attrs.get(FAILURE, "not known"),
        "values": " ".join(overrides_of(trial.params)),
    }


def _verdict_rows(verdict: Verdict) -> Iterable[dict[str, Any]]:
    for name, (mean, low, high) in verdict.means.items():
        yield {
            "trial": verdict.number,
            "seeds": verdict.n_seeds,
            "figure": name,
            "mean": mean,
            "low": low,
            "high": high,
        }


def _result_rows(found: Sequence[Verdict], trials: Sequence[FrozenTrial]) -> list[dict[str, Any]]:
    return [
        {
            "trial": verdict.number,
            "values": " ".join(overrides_of(trials[verdict.number].params)),
            "seeds": verdict.n_seeds,
            **{name.removeprefix("test/"): verdict.text(name) for name in shown_of(verdict)},
        }
        for verdict in found
    ]

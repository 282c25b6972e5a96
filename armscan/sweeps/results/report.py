"""The report of a study: one HTML file that needs no server, and all of its numbers as CSV files beside it."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from armscan.reports.html import Row, folded, table, video_address, write_page
from armscan.sweeps.results.charts import charts_of
from armscan.sweeps.results.csv_tables import all_numbers, cause_of
from armscan.sweeps.results.difference import HOW
from armscan.sweeps.results.final_results import ConfigResult, final_results, final_table
from armscan.sweeps.results.notes import notes_on
from armscan.sweeps.results.population_charts import population_charts
from armscan.sweeps.results.selection import candidates_of, decision_section
from armscan.sweeps.results.study_result import StudyResult, study_result
from armscan.sweeps.scheduling.state import CONTROL, StudyState, env_steps_of, is_feasible, was_retried
from armscan.sweeps.scheduling.termination import REASON
from armscan.sweeps.space.parameter import Value, overrides_of
from armscan.sweeps.storage.attribute_names import (
    EPISODES,
    FINALIST,
    FOLDER,
    LEASE,
    OBJECTIVES,
    RUN,
    TAKEN_FROM,
    TERMINATED,
)
from armscan.sweeps.study.candidates import name_of, settings_of
from armscan.sweeps.study.final_eval import FinalEvaluation
from armscan.sweeps.study.study import best_trials
from armscan.sweeps.tasks.folders import seed_folders
from armscan.training.metric_display import title_of, value_text
from armscan.utils.run_files import ID_CHARS, VIDEO_FILE
from armscan.utils.text import MISSING, counted

# Names of trial states for users.
STATES = {"complete": "finished", "fail": "failed"}
# First bytes of a GIF.
GIF = b"GIF8"


def write_report(
    study: optuna.Study,
    final_trials: Sequence[FrozenTrial],
    folder: Path,
    *,
    final: FinalEvaluation | None = None,
    refresh_s: int | None = None,
) -> Path:
    """Write the report of a study.

    Args:
        study: The study in its storage.
        final_trials: Trials on the test volumes; empty without a final evaluation.
        folder: Folder that takes `report.html` and the CSV files.
        final: Final evaluation of the study. Default: None, there is none, or an earlier version made it.
        refresh_s: Seconds after which a browser reloads the page. Default: None, never.

    Returns:
        The HTML file.
    """
    objectives = list(study.user_attrs[OBJECTIVES])
    trials, best = study.get_trials(deepcopy=False), best_trials(study, 1)
    state = StudyState.of(trials)
    result = study_result(final) if final is not None else None
    candidates = candidates_of(final) if final is not None else []
    # An earlier version evaluated its best configurations, without a control.
    found = final_results(final_trials) if final is None else result.results if result is not None else ()
    tables = all_numbers(study, trials, found, candidates, result)
    parts = [
        _summary(study, state, best, objectives),
        "<h2>Result</h2>",
        _comparison(result) if result is not None else "",
        _result(found, trials, final.control if final else None) if found else "<p>No final evaluation yet.</p>",
        decision_section(final, result, candidates, state) if final is not None else "",
        _running(state.running),
        *population_charts(trials, objectives[0], *best or (None,)),
        *charts_of(study, trials, objectives, tables["importances"]),
        _videos(final_trials),
        "<h2>Trials</h2>",
        _trials(trials, objectives) if trials else "<p>No trial has been begun.</p>",
        "<h2>States of the trials</h2>",
        table([{**row, "ending": _said(row["ending"])} for row in tables["endings"]]),
        "<h2>Failures</h2>",
        _failures(trials),
    ]
    return write_page(folder, f"Study {study.study_name}", parts, tables, refresh_s=refresh_s)


def _summary(study: optuna.Study, state: StudyState, best: Sequence[FrozenTrial], objectives: Sequence[str]) -> str:
    n_infeasible = sum(not is_feasible(trial) for trial in state.finished)
    taken = f"; {len(state.taken)} were taken from other studies" if state.taken else ""
    violating = f", {n_infeasible} infeasible" if n_infeasible else ""
    ended = study.user_attrs.get(TERMINATED, {}).get(REASON)
    hours = state.busy_hours
    text = (
        f"{counted(len(state.finished), 'trial')} finished, {state.n_pruned} of them pruned{violating}; "
        f"{len(state.running)} running, {len(state.failed)} failed, "
        f"{len(state.retried)} retried after their worker died{taken}. They took {state.env_steps:,} environment "
        f"steps in {f'{hours:.1f} hours' if hours >= 1 else f'{60 * hours:.1f} minutes'}, without the final trainings."
    )
    if ended:
        text += f" The study has ended early: {html.escape(ended)}."
    if best:
        values = zip(objectives, best[0].values, strict=True)
        said = "; ".join(f"{title_of(name)} {value_text(name, value)}" for name, value in values)
        text += f" Best in the search: trial {best[0].number}, {html.escape(said)} (optimistically biased)."
    text += "".join(f" Note: {html.escape(note)}." for note in notes_on(study))
    return f"<p>{text}</p>"


def _running(running: Sequence[FrozenTrial]) -> str:
    """Return a table of the running trials; an empty string if there are none."""
    rows = [
        {
            "trial": trial.number,
            "worker": str(lease.get("worker", MISSING)),
            "seed": lease.get("seed", MISSING),
            "environment steps": f"{env_steps_of(trial):,}",
            "return, mean": lease.get("return", MISSING),
            **_settings(trial.params),
        }
        for trial, lease in ((each, each.user_attrs.get(LEASE, {})) for each in running)
    ]
    return f"<h2>Running now</h2>{table(rows)}" if rows else ""


def _settings(values: Mapping[str, Any]) -> Row:
    """Return values by key; the table rounds them."""
    return {name: value if isinstance(value, int | float) else str(value) for name, value in values.items()}


def _trials(trials: Sequence[FrozenTrial], objectives: Sequence[str]) -> str:
    """Return a table of all trials, in the order of their numbers."""
    rows = []
    for trial in trials:
        is_complete = trial.state == TrialState.COMPLETE
        values = zip(objectives, trial.values, strict=True) if is_complete else ()
        rows.append(
            {
                "trial": trial.number,
                "state": _state(trial),
                **dict.fromkeys(map(title_of, objectives), ""),
                **{title_of(name): value_text(name, value) for name, value in values},
                **_settings(trial.params),
                "environment steps, all seeds": f"{env_steps_of(trial):,}",
                "run": str(trial.user_attrs.get(RUN, ""))[:ID_CHARS],
            }
        )
    return table(rows, what="trials")


def _state(trial: FrozenTrial) -> str:
    """Return the state of a trial, whether it was retried or violates a constraint, and the study it was taken from."""
    infeasible = "" if is_feasible(trial) else ", infeasible"
    elsewhere = f", in {trial.user_attrs[TAKEN_FROM]}" if TAKEN_FROM in trial.user_attrs else ""
    retried = ", retried" if was_retried(trial) else ""
    return f"{_said(trial.state.name.lower())}{retried}{infeasible}{elsewhere}"


def _failures(trials: Sequence[FrozenTrial]) -> str:
    failed = [trial for trial in trials if trial.state == TrialState.FAIL]
    rows = [{"trial": trial.number, "cause": cause_of(trial), **_settings(trial.params)} for trial in failed]
    return table(rows, what="failures") if rows else "<p>No trial has failed.</p>"


def _said(state: str) -> str:
    return STATES.get(state, state)


def _videos(final_trials: Sequence[FrozenTrial]) -> str:
    """Return one video of each configuration on the test volumes, from its first training with a video here."""
    videos: dict[int, str] = {}
    for trial in final_trials:
        number = trial.user_attrs[FINALIST]
        if number in videos:
            continue
        files = [each / VIDEO_FILE for each in seed_folders(Path(trial.user_attrs.get(FOLDER, "nowhere")))]
        read = (file.read_bytes() for file in files if file.is_file())
        # An untrusted folder may have links to any file of this user.
        if (video := next((each for each in read if each.startswith(GIF)), None)) is not None:
            caption = f"<figcaption>{name_of(number)}</figcaption>"
            videos[number] = f'<figure><img alt="an episode" src="{video_address(video)}">{caption}</figure>'
    # Trainings without episodes have no videos.
    if not videos and not any(EPISODES in trial.system_attrs for trial in final_trials):
        return ""
    missing = "<p>None: the folders of the final trainings are not here. Their runs have episode.gif.</p>"
    drawn = f'<div class="videos">{"".join(videos.values())}</div>' if videos else missing
    return f"<h2>Episodes on a test volume</h2>{drawn}"


def _comparison(result: StudyResult) -> str:
    """Return the result in a sentence, and the differences from the control."""
    notes = "".join(f"<p>Note: {html.escape(note)}.</p>" for note in result.notes)
    said = f"<p><strong>{html.escape(result.summary)}</strong></p>{notes}"
    if not result.differences:
        return said
    n_seeds = counted(result.n_seeds, "seed")
    seeds = f"Both were trained with the same {n_seeds}, which neither search nor selection has used."
    return f"{said}{table([each.row() for each in result.differences])}<p>{HOW} {seeds}</p>"


def _result(found: Sequence[ConfigResult], trials: Sequence[FrozenTrial], control: Mapping[str, Value] | None) -> str:
    """Return the table of the result, and the settings of each configuration in it, as far as they are known."""
    of_each = {result.number: settings_of(trials, result.number) for result in found}
    if CONTROL in of_each and control is not None:
        of_each[CONTROL] = dict(control)
    rows = [{"configuration": name_of(number), **_settings(settings)} for number, settings in of_each.items()]
    typed_of = {number: html.escape(" ".join(overrides_of(each))) for number, each in of_each.items() if each}
    items = "".join(f"<li>{name_of(number)}: <code>{text}</code></li>" for number, text in typed_of.items())
    typed = folded("As overrides, with all digits", f"<ul>{items}</ul>") if items else ""
    shown = f"<h3>Their settings</h3>{table(rows)}{typed}" if items else ""
    return f"{final_table(found).html()}{shown}"

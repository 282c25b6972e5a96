"""The result of a study, in the terminal."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence

from rich.table import Table
from rich.text import Text

from armscan.config.command_hints import armscan_command
from armscan.errors import print_error, printable
from armscan.experiment.console import print_result_table, print_where_to_look
from armscan.sweeps.results.difference import HOW
from armscan.sweeps.results.final_results import final_table
from armscan.sweeps.results.notes import notes_on
from armscan.sweeps.results.progress import status_line
from armscan.sweeps.results.selection import candidates_of, objective_of
from armscan.sweeps.results.study_result import study_result
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.space.parameter import rounded_overrides
from armscan.sweeps.storage.attribute_names import FAILURE
from armscan.sweeps.storage.attributes import check_trials
from armscan.sweeps.study.candidates import NOTHING_SEARCHED
from armscan.sweeps.study.final_eval import FinalEvaluation
from armscan.sweeps.study.phase import OpenedStudy
from armscan.sweeps.study.study import best_trials
from armscan.sweeps.tasks.folders import seed_folder, trial_folder
from armscan.training.metric_display import title_of, value_text
from armscan.utils.console import WHOLE_CHARS, print_sentence, wide_console
from armscan.utils.run_files import RUN_FILE
from armscan.utils.text import counted


def print_result(opened: OpenedStudy) -> int:
    """Print the result of a study; return the exit code, `os.EX_TEMPFAIL` if the same command continues the study."""
    scheduler, settings = opened.search.scheduler, opened.settings
    state = scheduler.state()
    print_sentence(status_line(opened, state))
    if stopped := scheduler.read_stop_request():
        print_sentence(printable(f"the study was stopped {stopped}; the same command resumes it"))
        return 0
    if wrong := scheduler.failure_reason(state):
        print_error(wrong)
        return 1
    if scheduler.end_reason(state) is None:
        unfinished = (
            f"the workers of this command have ended, but only {len(state.finished)} of {settings.n_trials} trials "
            f"have finished: their logs in {opened.folder / 'workers'} say why; the same command resumes the study"
        )
        print_error(unfinished)
        return os.EX_TEMPFAIL
    if scheduler.termination is not None and (ended := scheduler.termination.reason):
        told = f"the study has ended early: {ended}; to continue it, change study.n_trials or study.terminator"
        print_sentence(printable(told))
    elif len(state.finished) < settings.n_trials and (limit := settings.limit_reason(state)):
        print_sentence(f"the search has ended: {limit}")
    is_any_complete = len(state.finished) > state.n_pruned
    if settings.constraints and is_any_complete and not best_trials(scheduler.study, 1):
        print(f"no trial satisfies all constraints: {', '.join(map(str, settings.constraints))}")
    _print_best(opened)
    code = 0 if opened.final_eval is None else _print_final_results(opened, opened.final_eval)
    print_where_to_look(opened.folder, opened.config.tracking.uri, storage=settings.storage)
    _print_replay(opened)
    print(f"report    {armscan_command('report', '--study', settings.name, storage=settings.storage)}")
    return code


def _print_best(opened: OpenedStudy) -> None:
    """Print the best trials of the search."""
    objectives = opened.settings.objectives
    table = Table("trial", *map(title_of, objectives), title="best while searching", title_justify="left")
    best = best_trials(opened.search.scheduler.study, max(1, opened.settings.final_eval.top_k))
    for trial in best:
        table.add_row(str(trial.number), *map(value_text, objectives, trial.values))
    wide_console(WHOLE_CHARS).print(table)
    for trial in best:
        print_sentence(f"trial {trial.number}: {' '.join(rounded_overrides(searched_values(trial)))}")
    # The result of a study has these notes, too.
    for note in () if opened.final_eval is not None else notes_on(opened.search.scheduler.study):
        print_sentence(printable(f"note: {note}"))


def _print_replay(opened: OpenedStudy) -> None:
    """Print the commands that retrain the best member of a population with its whole schedule, one for each seed."""
    search = opened.search
    if search.population is not None and (best := best_trials(search.scheduler.study, 1)):
        for seed in opened.settings.seeds:
            file = seed_folder(trial_folder(search.folder, best[0].number), seed) / RUN_FILE
            # Its folder may have been pruned since.
            if not file.exists():
                continue
            run_id = json.loads(file.read_text())["run_id"]
            print(f"replay    {armscan_command('runs', 'reproduce', run_id, tracking=opened.config.tracking.uri)}")


def _print_final_results(opened: OpenedStudy, final: FinalEvaluation) -> int:
    """Print how a configuration was chosen, and its results on the test volumes; return the exit code."""
    trials = opened.search.scheduler.study.get_trials(deepcopy=False)
    unfinished, blocked = os.EX_TEMPFAIL, final.blocked()
    for phase in opened.finals:
        check_trials(phase.scheduler.study, n_searched=len(trials))
        if failed := phase.scheduler.failures(phase.scheduler.state()):
            unfinished, reason = 1, failed[0].user_attrs.get(FAILURE)
            again = "; fix the cause, and the same command trains them again" if phase.name in blocked else ""
            print_error(f"{counted(len(failed), 'training')} of {phase.name} failed: {reason}{again}")
    candidates = candidates_of(final)
    if candidates:
        objective = objective_of(final)
        title = f"selection on the validation volumes, by: {title_of(objective)}"
        _print_rows(title, [each.row(objective) for each in candidates])
    result = study_result(final)
    if result is None or result.of_chosen is None:
        nothing = "final training has finished" if candidates else "trial is complete and satisfies all constraints"
        if result is not None:
            nothing = "training of the chosen configuration on the test volumes has finished"
        code, reason = 1, f"no {nothing}"
        if not final.has_begun_all or final.n_untested:
            code, reason = unfinished, "trainings are missing; the same command resumes the study"
        print_error(f"no final evaluation, because {reason}")
        return code
    if result.differences:
        _print_rows(result.compared, [each.row() for each in result.differences])
        print_sentence(HOW)
    print_result_table("the test volumes", final_table(result.results), result.notes)
    for name, settings in result.settings.items():
        print_sentence(f"{name}: {settings or NOTHING_SEARCHED}")
    print_sentence(f"result: {result.summary}")
    if n_left := final.n_untested:
        print_error(f"trainings on the test volumes are missing ({n_left}); the same command resumes the study")
        return os.EX_TEMPFAIL
    return unfinished if blocked else 0


def _print_rows(title: str, rows: Sequence[Mapping[str, str]]) -> None:
    table = Table(*rows[0], title=Text(title), title_justify="left")
    for row in rows:
        table.add_row(*map(Text, row.values()))
    wide_console(WHOLE_CHARS).print(table)

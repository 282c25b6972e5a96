"""Progress of a study: one live table on a terminal, a line a trial elsewhere, the result at the end."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean

from optuna.trial import FrozenTrial, TrialState
from rich.live import Live
from rich.table import Table
from rich.text import Text

from armscan.config.command_hints import armscan_command
from armscan.errors import ArmscanError, printable
from armscan.experiment.console import print_table, print_where_to_look
from armscan.experiment.results import volume_notes
from armscan.sweeps.results.summary import final_results, final_table, values_of
from armscan.sweeps.scheduling.state import (
    ENV_STEPS,
    FAILURE,
    FINAL_SEED,
    FINALIST,
    LEASE,
    RETRIED,
    STOP,
    StudyState,
    is_feasible,
)
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.attributes import check_trials
from armscan.sweeps.study.open import OpenedStudy, Phase
from armscan.sweeps.study.study import best_trials
from armscan.utils.console import WHOLE_CHARS, wide_console
from armscan.utils.retry import no_retry

REFRESH_S = 2.0


@contextmanager
def progress_display(opened: OpenedStudy, folder: Path) -> Iterator[None]:
    """Show the progress of a study inside the context, from its storage.

    Args:
        opened: Study to show.
        folder: Folder of the workers that this command started.
    """
    shown, stopped = {key for key, *_ in _ended(opened)}, threading.Event()

    def print_new() -> None:
        for key, trial, phase in _ended(opened):
            if key not in shown:
                shown.add(key)
                print(printable(_describe(trial, phase.objectives)), flush=True)

    def show() -> None:
        # Nothing that is shown is worth waiting for: who leaves would wait for it, too.
        with no_retry():
            if not sys.stdout.isatty():
                repeat(print_new, stopped)
                return
            with Live(refresh_per_second=1) as live:
                repeat(lambda: live.update(_table(opened)), stopped)

    search = opened.search
    print(f"study {search.name} in {search.scheduler.storage.uri}, run {search.run_id}", flush=True)
    print(f"the workers write into {folder}", flush=True)
    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()


def repeat(show: Callable[[], None], stopped: threading.Event) -> None:
    """Show how a study is going again and again; where its storage is away or damaged, that it is, and nothing new.

    Args:
        show: Function that shows it once.
        stopped: Event that ends the repetition, after it is shown a last time.
    """
    told, is_last = "", False
    while not is_last:
        is_last = stopped.wait(REFRESH_S)
        try:
            show()
            told = ""
        except ArmscanError as error:
            if told != (told := str(error)):
                print(error, flush=True)


def _ended(opened: OpenedStudy) -> list[tuple[tuple[str, int], FrozenTrial, Phase]]:
    """Return the trials that have ended, with a key and the phase of each."""
    return [
        ((phase.name, trial.number), trial, phase)
        for phase in opened.phases
        for trial in phase.scheduler.study.get_trials(deepcopy=False)
        if trial.state.is_finished()
    ]


def _table(opened: OpenedStudy) -> Table:
    """Return the running trials, below how the study stands."""
    final = opened.final_eval
    state = opened.search.scheduler.state()
    final_state = final.scheduler.state() if final is not None else StudyState.of(())
    # As wide as the terminal.
    table = Table("worker", title=Text(_summary(opened, state)), title_justify="left", expand=True)
    for heading in ("trial", "seed", "environment steps", "return"):
        table.add_column(heading, justify="right")
    if final_state.all:
        table.caption = f"final evaluation: {len(final_state.finished)} of {len(final_state.all)} done"
    for trial in (*state.running, *final_state.running):
        lease, finalist = trial.user_attrs.get(LEASE, {}), trial.user_attrs.get(FINALIST)
        name = str(trial.number) if finalist is None else f"final evaluation of {finalist}: {trial.number}"
        mean_return = f"{lease['return']:.2f}" if "return" in lease else "-"
        shown = (lease.get("seed", "-"), lease.get(ENV_STEPS, "-"), mean_return)
        worker = printable(lease.get("worker", "?").rpartition("/")[2])
        table.add_row(Text(worker), name, *map(str, shown))
    return table


def _summary(opened: OpenedStudy, state: StudyState) -> str:
    """Return how a study stands, in one line."""
    settings = opened.settings
    n_pruned = sum(trial.state == TrialState.PRUNED for trial in state.finished)
    parts = [
        f"study {settings.name}: {len(state.finished)} of {settings.n_trials} trials done, {n_pruned} of them pruned",
        f"{len(state.running)} running, {len(state.failed)} failed, {len(state.retried)} retried",
    ]
    if best := best_trials(opened.search.scheduler.study, 1):
        parts.append(f"best {values_of(best[0], settings.objectives)} (trial {best[0].number})")
    durations = [trial.duration.total_seconds() for trial in state.finished if trial.duration is not None]
    if durations and len(state.finished) < settings.n_trials:
        left_s = (settings.n_trials - len(state.finished)) * fmean(durations) / settings.workers
        parts.append(f"{left_s // 60:.0f} min left")
    return "; ".join(parts)


def _describe(trial: FrozenTrial, objectives: Iterable[str]) -> str:
    """Return the outcome of a trial in one line."""
    attributes, tried = trial.user_attrs, " ".join(overrides_of(trial.params))
    name = f"trial {trial.number}"
    if FINALIST in attributes:
        name = f"final evaluation of trial {attributes[FINALIST]} with seed {attributes[FINAL_SEED]}"
    if trial.state == TrialState.FAIL:
        return f"{name} failed{', retried' if RETRIED in attributes else ''}: {attributes.get(FAILURE)} [{tried}]"
    if trial.state == TrialState.PRUNED:
        how = "stopped" if STOP in attributes else "pruned"
        return f"{name} {how} after {attributes.get(ENV_STEPS)} environment steps [{tried}]"
    infeasible = "" if is_feasible(trial) else ", infeasible"
    return f"{name} done{infeasible}: {values_of(trial, objectives)} [{tried}]"


def print_result(opened: OpenedStudy) -> int:
    """Print the result of a study; return the exit code."""
    scheduler, settings = opened.search.scheduler, opened.settings
    state = scheduler.state()
    print(_summary(opened, state))
    if stopped := scheduler.look_for_stop():
        print(printable(f"the study was stopped {stopped}; the same command resumes it"))
        return 0
    wrong = scheduler.broken(state)
    if wrong is None and scheduler.end(state) is None:
        wrong = (
            f"all workers have ended, but only {len(state.finished)} of {settings.n_trials} trials have finished: "
            f"their logs in {opened.folder / 'workers'} say why; the same command resumes the study"
        )
    if wrong:
        print(printable(f"error: {wrong}"), file=sys.stderr)
        return 1
    if scheduler.termination is not None and (ended := scheduler.termination.reason):
        print(printable(f"the study has ended by itself: {ended}; study.n_trials or study.terminator change that"))
    if settings.constraints and state.finished and not best_trials(scheduler.study, 1):
        print(f"no trial keeps all constraints: {', '.join(map(str, settings.constraints))}")
    table = Table("trial", *settings.objectives, "values", title="best while searching", title_justify="left")
    for trial in best_trials(scheduler.study, max(1, settings.final_eval.top_k)):
        table.add_row(
            str(trial.number), *(f"{value:.4g}" for value in trial.values), " ".join(overrides_of(trial.params))
        )
    wide_console(WHOLE_CHARS).print(table)
    is_evaluated = _print_final_results(opened)
    print_where_to_look(opened.folder, opened.config.tracking.uri, storage=settings.storage)
    print(f"report    {armscan_command('report', '--study', settings.name, storage=settings.storage)}")
    return 0 if is_evaluated else 1


def _print_final_results(opened: OpenedStudy) -> bool:
    """Print the final evaluation; returns whether there is one, if it is asked for."""
    if opened.final_eval is None:
        return True
    trials = opened.search.scheduler.study.get_trials(deepcopy=False)
    check_trials(opened.final_eval.scheduler.study, n_searched=len(trials))
    state = opened.final_eval.scheduler.state()
    if state.failed:
        reason = state.failed[0].user_attrs.get(FAILURE)
        print(printable(f"error: {len(state.failed)} of the final trainings have failed: {reason}"), file=sys.stderr)
    results = final_results(state.finished)
    if not results:
        print("error: no final evaluation, because no trial or no final training has finished", file=sys.stderr)
        return False
    n_seeds = ", ".join(sorted({str(result.n_seeds) for result in results}))
    title = f"result on the test volumes, with {n_seeds} other seed(s) each"
    print_table(title, final_table(results), volume_notes(results[0].figures))
    for result in results:
        print(f"trial {result.number}: {' '.join(overrides_of(trials[result.number].params))}")
    return True

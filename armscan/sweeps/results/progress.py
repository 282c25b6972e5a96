"""Progress of a study: a live table on a terminal, one line per trial elsewhere."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean

from optuna.trial import FrozenTrial, TrialState
from rich.live import Live
from rich.table import Table
from rich.text import Text

from armscan.errors import ArmscanError, printable
from armscan.sweeps.results.final_results import values_text
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.scheduling.state import StudyState, is_feasible, seconds_of, was_retried
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.attribute_names import (
    ENV_STEPS,
    FAILURE,
    FINAL_SEED,
    FINALIST,
    LEASE,
    STOP,
)
from armscan.sweeps.storage.attributes import TEST_SUFFIX
from armscan.sweeps.study.candidates import name_of
from armscan.sweeps.study.final_eval import FinalEvaluation
from armscan.sweeps.study.phase import OpenedStudy, Phase
from armscan.sweeps.study.plan import final_trainings_left
from armscan.sweeps.study.settings import StudySettings
from armscan.sweeps.study.study import best_trials
from armscan.utils.console import print_sentence
from armscan.utils.retry import no_retry
from armscan.utils.text import MISSING

REFRESH_S = 2.0


@contextmanager
def progress_display(opened: OpenedStudy, folder: Path) -> Iterator[None]:
    """Show the progress of a study inside the context, read from its storage.

    Args:
        opened: Study to show.
        folder: Folder of the workers that this command started.
    """
    shown, stopped = {key for key, *_ in _ended(opened)}, threading.Event()

    def print_new() -> None:
        for key, trial, phase in _ended(opened):
            if key not in shown:
                shown.add(key)
                print_sentence(printable(_describe(trial, phase)))

    def show() -> None:
        # A display need not wait for the storage, and a retry would delay the exit.
        with no_retry():
            if not sys.stdout.isatty():
                repeat(print_new, stopped)
                return
            # Transient: the result is printed in its place.
            with Live(refresh_per_second=1, transient=True) as live:
                repeat(lambda: live.update(_table(opened)), stopped)

    search = opened.search
    print_sentence(f"study {search.name} in {search.scheduler.storage.uri}, run {search.run_id}")
    print_sentence(f"the workers write their logs to {folder}")
    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()


def repeat(show: Callable[[], None], stopped: threading.Event) -> None:
    """Show a study's progress repeatedly; print an error if its storage is unavailable or damaged.

    Args:
        show: Function that shows it once.
        stopped: Event that ends the loop, after a last update.
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
    """Return a table of the running trials, with the state of the study as its title."""
    state = opened.search.scheduler.state()
    finals = [(phase, phase.scheduler.state()) for phase in opened.finals]
    # As wide as the terminal.
    table = Table("worker", title=Text(status_line(opened, state)), title_justify="left", expand=True)
    for heading in ("trial", "seed", "environment steps", "return"):
        table.add_column(heading, justify="right")
    if opened.final_eval is not None and any(of_final.all for _, of_final in finals):
        table.caption = final_line(opened.settings, opened.final_eval, [len(each.finished) for _, each in finals])
    for trial in (*state.running, *(trial for _, of_final in finals for trial in of_final.running)):
        lease, finalist = trial.user_attrs.get(LEASE, {}), trial.user_attrs.get(FINALIST)
        name = str(trial.number) if finalist is None else f"{name_of(finalist)}, final"
        mean_return = f"{lease['return']:.2f}" if "return" in lease else MISSING
        shown = (lease.get("seed", MISSING), lease.get(ENV_STEPS, MISSING), mean_return)
        worker = printable(lease.get("worker", "?").rpartition("/")[2])
        table.add_row(Text(worker), name, *map(str, shown))
    return table


def final_line(settings: StudySettings, final: FinalEvaluation, n_done: Sequence[int]) -> str:
    """Return the state of the final evaluation in one line."""
    _, n_left = final_trainings_left(settings, final, n_left=0)
    race, (n_selected, n_tested) = final.race(), n_done
    number, now = (race.leader, "has the best mean so far") if race.chosen is None else (race.chosen, "chosen")
    stands = "" if number is None else f"; {name_of(number)} {now}"
    done = f"{n_selected} selection and {n_tested} test trainings done"
    return f"final evaluation: {done}, at most {n_left} left{stands}"


def status_line(opened: OpenedStudy, state: StudyState) -> str:
    """Return the state of a study in one line."""
    settings = opened.settings
    n_done = len(state.finished)
    # Another command may have asked for more.
    of_all = f" of {settings.n_trials}" if n_done <= settings.n_trials else ""
    done = f"{n_done}{of_all} trials done, {state.n_pruned} of them pruned"
    parts = [
        f"study {settings.name}: {done}",
        f"{len(state.running)} running, {len(state.failed)} failed, {len(state.retried)} retried",
    ]
    if best := best_trials(opened.search.scheduler.study, 1):
        parts.append(f"best {values_text(best[0], settings.objectives)} (trial {best[0].number})")
    durations = [seconds for trial in state.finished if (seconds := seconds_of(trial)) is not None]
    if durations and opened.search.scheduler.end_reason(state) is None:
        left_s = (settings.n_trials - len(state.finished)) * fmean(durations) / settings.workers
        parts.append(f"about {left_s // 60:.0f} min left for the trials")
    return "; ".join(parts)


def _describe(trial: FrozenTrial, phase: Phase) -> str:
    """Return the outcome of a trial in one line."""
    attributes, tried = trial.user_attrs, " ".join(overrides_of(searched_values(trial)))
    name = f"trial {trial.number}"
    what = "test" if phase.name.endswith(TEST_SUFFIX) else "selection"
    if FINALIST in attributes:
        name = f"{what} of {name_of(attributes[FINALIST])} with seed {attributes[FINAL_SEED]}"
    if trial.state == TrialState.FAIL:
        return f"{name} failed{', retried' if was_retried(trial) else ''}: {attributes.get(FAILURE)} [{tried}]"
    if trial.state == TrialState.PRUNED:
        how = "stopped" if STOP in attributes else "pruned"
        return f"{name} {how} after {attributes.get(ENV_STEPS)} environment steps [{tried}]"
    infeasible = "" if is_feasible(trial) else ", infeasible"
    return f"{name} done{infeasible}: {values_text(trial, phase.objectives)}{f' [{tried}]' if tried else ''}"

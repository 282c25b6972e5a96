"""What a person sees of a study: one live table on a terminal, a line a trial elsewhere, the result at the end."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from optuna.trial import FrozenTrial, TrialState
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from armscan.config.command_hints import report_command
from armscan.errors import StorageAwayError
from armscan.experiment.console import print_where_to_look
from armscan.sweeps.results.summary import final_results, shown_of
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import ENV_STEPS, FAILURE, FINAL_SEED, FINALIST, LEASE, RETRIED, StudyState
from armscan.sweeps.space.overrides import overrides_of
from armscan.sweeps.study.finalists import best_trials
from armscan.sweeps.study.open import OpenedStudy
from armscan.sweeps.study.phase import Phase
from armscan.sweeps.study.settings import StudySettings
from armscan.utils.retry import no_retry

REFRESH_S = 2.0


class ProgressDisplay:
    """Shows how a study is going, from what stands in its storage, while it lasts.

    Args:
        opened: the study.
        folder: of the workers of this start.
    """

    def __init__(self, opened: OpenedStudy, folder: Path) -> None:
        self._opened, self._scheduler = opened, opened.search.scheduler
        self._shown = {(phase.name, trial.number) for phase, trial in self._ended()}
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._show, daemon=True)
        print(f"study {opened.settings.name} in {opened.storage.uri}, run {opened.run_id}", flush=True)
        print(f"the workers write into {folder}", flush=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopped.set()
        self._thread.join()

    def _show(self) -> None:
        # Nothing that is shown is worth waiting for: who leaves would wait for it, too.
        with no_retry():
            if not sys.stdout.isatty():
                self._repeat(self._print_new)
                return
            with Live(refresh_per_second=1) as live:
                self._repeat(lambda: live.update(self._table()))

    def _repeat(self, show: Callable[[], None]) -> None:
        """Show how the study is going again and again; where its storage is away, that it is, and nothing new."""
        is_away, is_last = False, False
        while not is_last:
            is_last = self._stopped.wait(REFRESH_S)
            try:
                show()
                is_away = False
            except StorageAwayError as error:
                if not is_away:
                    print(error, flush=True)
                is_away = True

    def _ended(self) -> list[tuple[Phase, FrozenTrial]]:
        """Return the trials that have ended, with their phases."""
        return [
            (phase, trial)
            for phase in self._opened.phases
            for trial in phase.scheduler.study.get_trials(deepcopy=False)
            if trial.state.is_finished()
        ]

    def _print_new(self) -> None:
        for phase, trial in self._ended():
            if (phase.name, trial.number) not in self._shown:
                self._shown.add((phase.name, trial.number))
                print(describe_trial(trial, phase.objectives), flush=True)

    def _table(self) -> Table:
        state, settings = self._scheduler.state(), self._opened.settings
        final = self._opened.final_eval
        final_state = final.scheduler.state() if final is not None else StudyState.of(())
        # As wide as the terminal, whatever the table has.
        table = Table(title=Text(summary(self._scheduler, state, settings)), title_justify="left", expand=True)
        if final_state.all:
            table.caption = f"final evaluation: {len(final_state.finished)} of {len(final_state.all)} done"
        for heading in ("worker", "trial", "seed", "environment steps", "return"):
            table.add_column(heading, justify="left" if heading == "worker" else "right")
        running = [("", trial) for trial in state.running]
        running += [(f"final evaluation of {trial.user_attrs[FINALIST]}: ", trial) for trial in final_state.running]
        for what, trial in running:
            lease = trial.user_attrs.get(LEASE, {})
            mean_return = f"{lease['return']:.2f}" if "return" in lease else "-"
            shown = (lease.get("seed", "-"), lease.get(ENV_STEPS, "-"), mean_return)
            table.add_row(lease.get("worker", "?").rpartition("/")[2], f"{what}{trial.number}", *map(str, shown))
        return table


def summary(scheduler: TrialScheduler, state: StudyState, settings: StudySettings) -> str:
    """Return how a study stands, in one line."""
    n_pruned = sum(trial.state == TrialState.PRUNED for trial in state.finished)
    parts = [
        f"study {settings.name}: {len(state.finished)} of {settings.n_trials} trials done, {n_pruned} of them pruned"
    ]
    parts += [f"{len(state.running)} running, {len(state.failed)} failed, {len(state.retried)} retried"]
    if best := best_trials(scheduler.study, 1):
        parts.append(f"best {_values(best[0], tuple(settings.objectives))} (trial {best[0].number})")
    durations = [trial.duration.total_seconds() for trial in state.finished if trial.duration is not None]
    if durations and len(state.finished) < settings.n_trials:
        left_s = (settings.n_trials - len(state.finished)) * sum(durations) / len(durations) / settings.workers
        parts.append(f"{left_s // 60:.0f} min left")
    return "; ".join(parts)


def describe_trial(trial: FrozenTrial, objectives: Sequence[str]) -> str:
    """Return what became of a trial, whose values are those of these objectives, in one line."""
    attributes, tried = trial.user_attrs, " ".join(overrides_of(trial.params))
    name = f"trial {trial.number}"
    if FINALIST in attributes:
        name = f"final evaluation of trial {attributes[FINALIST]} with seed {attributes[FINAL_SEED]}"
    if trial.state == TrialState.FAIL:
        return f"{name} failed{', retried' if RETRIED in attributes else ''}: {attributes.get(FAILURE)} [{tried}]"
    if trial.state == TrialState.PRUNED:
        return f"{name} pruned after {attributes.get(ENV_STEPS)} environment steps [{tried}]"
    return f"{name} done: {_values(trial, objectives)} [{tried}]"


def print_result(opened: OpenedStudy) -> int:
    """Print what a study has found; returns the exit code."""
    scheduler, settings = opened.search.scheduler, opened.settings
    state = scheduler.state()
    print(summary(scheduler, state, settings))
    if wrong := scheduler.broken(state) or _unfinished(opened, scheduler, state):
        print(f"error: {wrong}", file=sys.stderr)
        return 1
    table = Table(title="best while searching", title_justify="left")
    for heading in ("trial", *settings.objectives, "values"):
        table.add_column(heading)
    for trial in best_trials(scheduler.study, max(1, settings.final_eval.top_k)):
        table.add_row(
            str(trial.number), *(f"{value:.4g}" for value in trial.values), " ".join(overrides_of(trial.params))
        )
    Console().print(table)
    is_evaluated = _print_final_results(opened)
    print_where_to_look(opened.folder, opened.config.tracking.uri, storage=settings.storage)
    print(f"report    {report_command(settings.name, settings.storage)}")
    return 0 if is_evaluated else 1


def _unfinished(opened: OpenedStudy, scheduler: TrialScheduler, state: StudyState) -> str | None:
    """Return the message for a study whose workers all exited early; None if it is complete."""
    if scheduler.end(state) is not None:
        return None
    return (
        f"all workers have ended, but only {len(state.finished)} of {opened.settings.n_trials} trials have finished: "
        f"their logs in {opened.folder / 'workers'} say why; the same command resumes the study"
    )


def _print_final_results(opened: OpenedStudy) -> bool:
    """Print the final evaluation; returns whether there is one, if it is asked for."""
    if opened.final_eval is None:
        return True
    state = opened.final_eval.scheduler.state()
    if state.failed:
        reason = state.failed[0].user_attrs.get(FAILURE)
        print(f"error: {len(state.failed)} of the final trainings have failed: {reason}", file=sys.stderr)
    results = final_results(state.finished)
    if not results:
        print("error: no final evaluation, because no trial or no final training has finished", file=sys.stderr)
        return False
    n_seeds = ", ".join(sorted({str(result.n_seeds) for result in results}))
    # A title of the table would be as narrow as the table.
    print(
        f"result, with {n_seeds} other seed(s) each: interquartile means over seeds and test volumes, of success rates "
        "means; 95 % intervals"
    )
    table = Table()
    names = shown_of(results[0])
    for heading in ("trial", *(name.removeprefix("test/").replace("_", " ") for name in names)):
        table.add_column(heading)
    trials = opened.search.scheduler.study.get_trials(deepcopy=False)
    for result in results:
        table.add_row(str(result.number), *(result.text(name).replace(" (", "\n(") for name in names))
    Console().print(table)
    for result in results:
        print(f"trial {result.number}: {' '.join(overrides_of(trials[result.number].params))}")
    return True


def _values(trial: FrozenTrial, objectives: Sequence[str]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in zip(objectives, trial.values, strict=True))

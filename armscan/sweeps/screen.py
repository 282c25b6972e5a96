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

from armscan.console import print_where_to_look
from armscan.errors import StorageAwayError
from armscan.patience import impatient
from armscan.settings import report_command
from armscan.sweeps.judging import best_trials
from armscan.sweeps.ledger import Ledger
from armscan.sweeps.opening import OpenStudy
from armscan.sweeps.settings import StudySettings
from armscan.sweeps.tally import ENV_STEPS, FAILURE, JUDGED, JUDGED_SEED, LEASE, RETRIED, Tally
from armscan.sweeps.values import overrides_of
from armscan.sweeps.verdict import shown_of, verdicts

REFRESH_S = 2.0


class Screen:
    """Shows how a study is going, from what stands in its storage, while it lasts.

    Args:
        opened: the study.
        folder: of the workers of this start.
    """

    def __init__(self, opened: OpenStudy, folder: Path) -> None:
        self._opened, self._ledger = opened, opened.searching().ledger
        self._told = {(trial.number, is_judging) for trial, is_judging in self._ended()}
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
        with impatient():
            if not sys.stdout.isatty():
                self._repeat(self._tell)
                return
            with Live(refresh_per_second=1) as live:
                self._repeat(lambda: live.update(self._table()))

    def _repeat(self, show: Callable[[], None]) -> None:
        """Shows how the study is going again and again; where its storage is away, that it is, and nothing new."""
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

    def _ended(self) -> list[tuple[FrozenTrial, bool]]:
        """The trials that have ended, and whether they judge."""
        studies = [(self._ledger.study, False)]
        if (judging := self._opened.judged()) is not None:
            studies.append((judging, True))
        return [
            (trial, is_judging)
            for study, is_judging in studies
            for trial in study.get_trials(deepcopy=False)
            if trial.state.is_finished()
        ]

    def _tell(self) -> None:
        for trial, is_judging in self._ended():
            if (trial.number, is_judging) not in self._told:
                self._told.add((trial.number, is_judging))
                names = (self._opened.task.judged,) if is_judging else tuple(self._opened.settings.objectives)
                print(sentence(trial, names), flush=True)

    def _table(self) -> Table:
        tally, settings = self._ledger.tally(), self._opened.settings
        judging = self._opened.judged()
        of_judging = Tally.of(judging.get_trials(deepcopy=False)) if judging is not None else Tally.of(())
        # As wide as the terminal, whatever the table has.
        table = Table(title=Text(summary(self._ledger, tally, settings)), title_justify="left", expand=True)
        if of_judging.all:
            table.caption = f"judging: {len(of_judging.finished)} of {len(of_judging.all)} done"
        for heading in ("worker", "trial", "seed", "environment steps", "return"):
            table.add_column(heading, justify="left" if heading == "worker" else "right")
        running = [("", trial) for trial in tally.running]
        running += [(f"judging {trial.user_attrs[JUDGED]}: ", trial) for trial in of_judging.running]
        for what, trial in running:
            lease = trial.user_attrs.get(LEASE, {})
            figure = f"{lease['return']:.2f}" if "return" in lease else "-"
            shown = (lease.get("seed", "-"), lease.get(ENV_STEPS, "-"), figure)
            table.add_row(lease.get("worker", "?").rpartition("/")[2], f"{what}{trial.number}", *map(str, shown))
        return table


def summary(ledger: Ledger, tally: Tally, settings: StudySettings) -> str:
    """Returns how a study stands, in one line."""
    n_pruned = sum(trial.state == TrialState.PRUNED for trial in tally.finished)
    parts = [
        f"study {settings.name}: {len(tally.finished)} of {settings.n_trials} trials done, {n_pruned} of them pruned"
    ]
    parts += [f"{len(tally.running)} running, {len(tally.failed)} failed, {len(tally.retried)} taken up again"]
    if best := best_trials(ledger.study, 1):
        parts.append(f"best {_values(best[0], tuple(settings.objectives))} (trial {best[0].number})")
    durations = [trial.duration.total_seconds() for trial in tally.finished if trial.duration is not None]
    if durations and len(tally.finished) < settings.n_trials:
        left_s = (settings.n_trials - len(tally.finished)) * sum(durations) / len(durations) / settings.workers
        parts.append(f"{left_s // 60:.0f} min left")
    return "; ".join(parts)


def sentence(trial: FrozenTrial, objectives: Sequence[str]) -> str:
    """Returns what became of a trial, whose values are those of these objectives, in one line."""
    told, tried = trial.user_attrs, " ".join(overrides_of(trial.params))
    name = f"trial {trial.number}"
    if JUDGED in told:
        name = f"judging trial {told[JUDGED]} with seed {told[JUDGED_SEED]}"
    if trial.state == TrialState.FAIL:
        return f"{name} failed{', taken up again' if RETRIED in told else ''}: {told.get(FAILURE)} [{tried}]"
    if trial.state == TrialState.PRUNED:
        return f"{name} pruned after {told.get(ENV_STEPS)} environment steps [{tried}]"
    return f"{name} done: {_values(trial, objectives)} [{tried}]"


def print_result(opened: OpenStudy) -> int:
    """Prints what a study has found; returns the exit code."""
    ledger, settings = opened.searching().ledger, opened.settings
    tally = ledger.tally()
    print(summary(ledger, tally, settings))
    if wrong := ledger.broken(tally) or _unfinished(opened, ledger, tally):
        print(f"error: {wrong}", file=sys.stderr)
        return 1
    table = Table(title="best while searching", title_justify="left")
    for heading in ("trial", *settings.objectives, "values"):
        table.add_column(heading)
    for trial in best_trials(ledger.study, max(1, settings.judging.best)):
        table.add_row(
            str(trial.number), *(f"{value:.4g}" for value in trial.values), " ".join(overrides_of(trial.params))
        )
    Console().print(table)
    is_judged = _print_verdicts(opened)
    print_where_to_look(opened.folder, opened.config.tracking.uri, storage=settings.storage)
    print(f"report    {report_command(settings.name, settings.storage)}")
    return 0 if is_judged else 1


def _unfinished(opened: OpenStudy, ledger: Ledger, tally: Tally) -> str | None:
    """Returns what to say of a study that has ended without an end."""
    if ledger.end(tally) is not None:
        return None
    return (
        f"all workers have ended, but only {len(tally.finished)} of {opened.settings.n_trials} trials have finished: "
        f"their logs in {opened.folder / 'workers'} say why; the same command goes on"
    )


def _print_verdicts(opened: OpenStudy) -> bool:
    """Prints the table that is the result of a study, where it is to be judged; returns whether anything was."""
    study = opened.judged()
    tally = Tally.of(study.get_trials(deepcopy=False) if study is not None else ())
    if opened.settings.judging.best and tally.failed:
        reason = tally.failed[0].user_attrs.get(FAILURE)
        print(f"error: {len(tally.failed)} of the trials that judge have failed: {reason}", file=sys.stderr)
    judged = verdicts(tally.finished)
    if not judged:
        if opened.settings.judging.best:
            print(
                "error: nothing has been judged, because no trial has run to its end, or none that judges has",
                file=sys.stderr,
            )
        return not opened.settings.judging.best
    n_seeds = ", ".join(sorted({str(verdict.n_seeds) for verdict in judged}))
    # A title of the table would be as narrow as the table.
    print(
        f"result, with {n_seeds} other seed(s) each: interquartile means over seeds and test volumes, of success rates "
        "means; 95 % intervals"
    )
    table = Table()
    names = shown_of(judged[0])
    for heading in ("trial", *(name.removeprefix("test/").replace("_", " ") for name in names)):
        table.add_column(heading)
    trials = opened.searching().ledger.study.get_trials(deepcopy=False)
    for verdict in judged:
        table.add_row(str(verdict.number), *(verdict.text(name).replace(" (", "\n(") for name in names))
    Console().print(table)
    for verdict in judged:
        print(f"trial {verdict.number}: {' '.join(overrides_of(trials[verdict.number].params))}")
    return True


def _values(trial: FrozenTrial, objectives: Sequence[str]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in zip(objectives, trial.values, strict=True))

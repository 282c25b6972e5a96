"""What a person sees in the terminal: progress while a run goes on, tables of results at its end."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column, Table

from armscan.multirun import INTERRUPTED, Outcome
from armscan.settings import ui_command
from armscan.training import TEST, Callback, EpochReport, Evaluation

# Of a run's id, where there is no room for all of it.
ID_CHARS = 8
RESULT_ROWS = (
    ("success rate", "success_rate", "{:.1%}"),
    ("mean steps", "mean_steps", "{:.2f}"),
    ("mean final reward", "mean_final_reward", "{:.3f}"),
    ("mean distance to the plane", "mean_distance_mm", "{:.1f} mm"),
    ("mean angle to the plane", "mean_distance_deg", "{:.1f}°"),
    ("mean Dice with its slice", "mean_dice", "{:.2f}"),
    ("episodes", "episodes", "{:.0f}"),
    ("... of which started solved", "episodes_started_solved", "{:.0f}"),
    ("success rate of the others", "success_rate_not_started_solved", "{:.1%}"),
    ("mean steps of the others", "mean_steps_not_started_solved", "{:.2f}"),
)


def progress_reporter(label: str | None = None) -> Callback:
    """Returns a progress bar on a terminal; a line an epoch elsewhere, or where `label` names one job of many."""
    if label is None and sys.stdout.isatty():
        return ProgressBar()
    return ProgressLines(label)


class ProgressBar:
    """A bar with steps, return, success rate and time left."""

    def __init__(self) -> None:
        # Of a narrow terminal, the figures get what they need, and the bar what is left.
        whole = Column(no_wrap=True)
        self._progress = Progress(
            BarColumn(bar_width=None, table_column=Column(ratio=1, min_width=4)),
            *(MofNCompleteColumn(table_column=whole), TextColumn("{task.fields[figures]}", table_column=whole)),
            TimeRemainingColumn(table_column=whole),
            expand=True,
        )

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Shows the bar, as far as training has come."""
        self._task = self._progress.add_task("training", total=total_env_steps, figures="")
        for report in earlier[-1:]:
            self.on_epoch(report)
        self._progress.start()

    def on_epoch(self, report: EpochReport) -> None:
        """Moves the bar."""
        self._progress.update(self._task, completed=report.n_env_steps, figures=_figures(report))

    def on_end(self) -> None:
        """Leaves the bar as it is."""
        self._progress.stop()


class ProgressLines:
    """A line an epoch, for logs and for jobs side by side.

    Args:
        label: before each line, None for none.
    """

    def __init__(self, label: str | None) -> None:
        self._label = f"[{label}] " if label else ""

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Says that training begins, or goes on."""
        self._total = total_env_steps
        self._start_s = time.perf_counter() - (earlier[-1].wall_s if earlier else 0.0)
        after = f", {earlier[-1].n_env_steps} of them taken" if earlier else ""
        print(f"{self._label}training for at most {total_env_steps} environment steps{after}", flush=True)

    def on_epoch(self, report: EpochReport) -> None:
        """Writes the epoch's line."""
        elapsed_s = time.perf_counter() - self._start_s
        left_s = elapsed_s * (self._total / report.n_env_steps - 1)
        minutes, seconds = divmod(round(max(0.0, left_s)), 60)
        line = f"{report.n_env_steps:>{len(str(self._total))}}/{self._total} steps  {_figures(report)}"
        print(f"{self._label}{line}  {minutes}:{seconds:02d} left", flush=True)

    def on_end(self) -> None:
        """Has said everything."""


def _figures(report: EpochReport) -> str:
    metrics = report.evaluation.metrics()
    return (
        f"return {metrics['mean_return']:6.2f}  success {metrics['success_rate']:4.0%}  "
        f"length {metrics['mean_steps']:5.2f}"
    )


def print_results(title: str, evaluations: Mapping[str, Evaluation]) -> None:
    """Prints a table with a column for each evaluation, by the name of its volumes."""
    figures = {name: evaluation.metrics() for name, evaluation in evaluations.items()}
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for name in figures:
        table.add_column(name, justify="right")
    for text, key, form in RESULT_ROWS:
        table.add_row(text, *("-" if f[key] != f[key] else form.format(f[key]) for f in figures.values()))
    Console().print(table)


def print_jobs(outcomes: Mapping[str, Outcome], run_ids: Mapping[str, str]) -> None:
    """Prints the table of a multirun's jobs.

    Args:
        outcomes: of the jobs, by their numbers.
        run_ids: of those that got as far as a run, likewise.
    """
    table = Table(title=f"jobs ({TEST})", title_justify="left")
    for heading in ("job", "run", "overrides", "outcome", "success rate", "mean steps"):
        table.add_column(heading)
    for number, outcome in outcomes.items():
        judged = outcome.figures.get(TEST, {})
        figures = [f"{judged['success_rate']:.1%}", f"{judged['mean_steps']:.2f}"] if judged else ["-", "-"]
        ended = {None: "done", INTERRUPTED: INTERRUPTED}.get(outcome.failure, "failed")
        table.add_row(number, run_ids.get(number, "-")[:ID_CHARS], outcome.varied, ended, *figures)
    Console().print(table)


def print_where_to_look(
    folder: Path, tracking_uri: str, *, storage: str | None = None, files: Sequence[str] = ("",)
) -> None:
    """Prints where the results lie, and the command that opens the UI over all runs.

    Args:
        folder: of the run or multirun.
        tracking_uri: of the store.
        storage: of the study, None where there is none.
        files: what is worth looking at in the folder; the folder itself where none is named.
    """
    for file in files:
        print(f"look at   {from_here(folder / file)}")
    print(f"all runs  {ui_command(tracking=tracking_uri, storage=storage)}")


def from_here(path: Path) -> Path:
    """Returns a path as one would type it in the current folder."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path

"""Progress of a training in the terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from rich import get_console
from rich.console import RenderableType
from rich.constrain import Constrain
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column
from rich.text import Text

from armscan.training.callbacks import Callback, EpochReport
from armscan.utils.console import print_sentence
from armscan.utils.text import PERCENT, format_duration, formatted


def progress_reporter(label: str | None, measured: str) -> Callback:
    """Return a progress bar on a terminal; elsewhere, or with the label of a job, one line per epoch.

    Args:
        label: Label of the job; None for a single run.
        measured: Origin of the figures, such as `validation, 48 episodes, deterministic`.
    """
    return ProgressBar(measured) if label is None and sys.stdout.isatty() else ProgressLines(label, measured)


class _NarrowProgress(Progress):
    """A bar that leaves the terminal's last columns free: the echo of Ctrl-C would wrap to the next line there."""

    def get_renderable(self) -> RenderableType:
        """Return the bar, narrower than the terminal."""
        return Constrain(super().get_renderable(), get_console().width - len("^C"))


class ProgressBar:
    """A bar with environment steps, on-plane rate, success rate, mean steps of the validation, and time left.

    Args:
        measured: Origin of the figures; see `progress_reporter`.
    """

    def __init__(self, measured: str) -> None:
        self._measured = measured
        # On a narrow terminal the numbers keep their width; the bar shrinks.
        fixed = Column(no_wrap=True)
        self._progress = _NarrowProgress(
            BarColumn(bar_width=None, table_column=Column(ratio=1, min_width=4)),
            *(MofNCompleteColumn(table_column=fixed), TextColumn("{task.fields[metrics]}", table_column=fixed)),
            TimeRemainingColumn(table_column=fixed),
            expand=True,
        )

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Show the bar, from the last epoch of a resumed training on."""
        self._task = self._progress.add_task("training", total=total_env_steps, metrics="")
        for report in earlier[-1:]:
            self.on_epoch(report)
        self._progress.console.print(Text(f"training; figures: {self._measured}"))
        self._progress.start()

    def on_epoch(self, report: EpochReport) -> None:
        """Move the bar."""
        self._progress.update(self._task, completed=report.n_env_steps, metrics=_summary(report))

    def on_end(self) -> None:
        """Stop the bar."""
        self._progress.stop()


class ProgressLines:
    """One line per epoch, for logs and for jobs side by side; a label, if there is one, is printed before each."""

    def __init__(self, label: str | None, measured: str) -> None:
        self._label, self._measured = f"[{label}] " if label else "", measured

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Print the budget of the training."""
        self._total = total_env_steps
        self._start_s = time.perf_counter() - (earlier[-1].wall_s if earlier else 0.0)
        after = f", {earlier[-1].n_env_steps} of them taken" if earlier else ""
        at_most = f"training for at most {total_env_steps} environment steps{after}"
        print_sentence(f"{self._label}{at_most}; figures: {self._measured}")

    def on_epoch(self, report: EpochReport) -> None:
        """Print the epoch's line."""
        elapsed_s = time.perf_counter() - self._start_s
        left_s = elapsed_s * (self._total / report.n_env_steps - 1)
        line = f"{report.n_env_steps:>{len(str(self._total))}}/{self._total} steps  {_summary(report)}"
        print_sentence(f"{self._label}{line}  {format_duration(max(0.0, left_s))} left")

    def on_end(self) -> None:
        """Do nothing."""


def _summary(report: EpochReport) -> str:
    """Return the figures of an epoch's validation, the leading rate first."""
    evaluation = report.evaluation
    on_plane, success = (formatted(PERCENT, rate) for rate in (evaluation.on_plane_rate, evaluation.success_rate))
    return f"{evaluation.on_plane[0].title} {on_plane:>4}  success {success:>4}  steps {evaluation.mean_steps:5.2f}"

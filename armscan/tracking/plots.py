"""The plot of a learning curve."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from armscan.utils.files import atomic_write

if TYPE_CHECKING:
    from armscan.training import EpochReport


def draw_learning_curve(reports: Sequence[EpochReport], path: Path, *, title: str) -> None:
    """Draw on-plane rate, success rate and mean steps by environment step.

    Args:
        reports: Reports of the epochs, one or more.
        path: File to write; its suffix, such as `.png`, is its format.
        title: Title of the figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from armscan.training.callbacks import best_of

    steps = [report.n_env_steps for report in reports]
    figure = Figure(figsize=(8, 5.4))
    # Fixed margins: matplotlib's automatic layout draws the figure twice.
    figure.subplots_adjust(left=0.09, right=0.98, bottom=0.09, top=0.92, hspace=0.08)
    FigureCanvasAgg(figure)
    rates, lengths = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
    limits = reports[0].evaluation.on_plane[0]
    for label, values, colour in (
        (limits.title, [report.evaluation.on_plane_rate for report in reports], "tab:blue"),
        ("success, by reward", [report.evaluation.success_rate for report in reports], "tab:green"),
    ):
        rates.plot(steps, [100 * value for value in values], marker="o", color=colour, label=label)
    rates.set_ylabel("of validation episodes (%)")
    rates.set_ylim(-3, 103)
    lengths.plot(steps, [report.evaluation.mean_steps for report in reports], marker="o", label="validation")
    trained = [
        (report.n_env_steps, report.metrics["train/length"]) for report in reports if "train/length" in report.metrics
    ]
    if trained:
        lengths.plot(*zip(*trained, strict=True), marker=".", alpha=0.6, label="training, exploring")
    best = best_of(reports)
    for axes in (rates, lengths):
        axes.axvline(best.n_env_steps, color="grey", linestyle=":", label=f"best epoch, kept: step {best.n_env_steps}")
    lengths.set_ylabel("steps, mean")
    lengths.set_ylim(bottom=0)
    lengths.set_xlabel("environment steps")
    # Corners that curves rarely reach: matplotlib's search for the best one takes seconds on a busy machine, and warns.
    for axes, place in ((rates, "lower right"), (lengths, "upper right")):
        axes.legend(loc=place)
        axes.grid(alpha=0.3)
    figure.suptitle(title)
    atomic_write(path, lambda file: figure.savefig(file, dpi=110, format=path.suffix[1:]))

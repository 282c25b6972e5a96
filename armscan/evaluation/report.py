"""The report of an evaluation: metrics with intervals by split and by volume, as JSON, for MLflow, as tables."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from armscan.stats.bootstrap import LEVEL, N_RESAMPLES, Estimate
from armscan.training import Evaluation, MetricEstimates
from armscan.training.metrics import NOT_STARTED_SOLVED

TOTAL = "all volumes"
# What MLflow takes in the name of a metric.
REFUSED_BY_MLFLOW = re.compile(r"[^A-Za-z0-9_\-. /:]")
SUMMARY_ROWS = (
    ("success rate", "success_rate", "{:.1%}"),
    ("mean steps", "mean_steps", "{:.2f}"),
    ("median steps", "median_steps", "{:.1f}"),
    ("95th percentile of steps", "p95_steps", "{:.1f}"),
    ("mean final reward", "mean_final_reward", "{:.3f}"),
    ("mean best reward", "mean_best_reward", "{:.3f}"),
    ("mean distance (mm)", "mean_distance_mm", "{:.1f}"),
    ("median distance (mm)", "median_distance_mm", "{:.1f}"),
    ("mean angle (°)", "mean_distance_deg", "{:.1f}"),
    ("median angle (°)", "median_distance_deg", "{:.1f}"),
    ("mean Dice, bones", "mean_dice_bones", "{:.2f}"),
    ("mean Dice, tendons", "mean_dice_tendons", "{:.2f}"),
    ("mean Dice, artery", "mean_dice_artery", "{:.2f}"),
    ("time per plane (ms)", "mean_seconds_per_plane", "{:.2f}"),
)
COUNTS = (("volumes", "n_volumes"), ("episodes", "n_episodes"), ("started solved", "n_started_solved"))
N_ROWS_OF_THE_OTHERS = 3
"""Of the rows above, how many are also shown of the episodes that did not start solved."""
VOLUME_COLUMNS = (
    ("success", "success_rate", "{:.0%}"),
    ("steps", "mean_steps", "{:.1f}"),
    ("mm", "mean_distance_mm", "{:.1f}"),
    ("°", "mean_distance_deg", "{:.1f}"),
    ("Dice", "mean_dice", "{:.2f}"),
)


@dataclass(frozen=True)
class EvaluationReport:
    """An evaluation that has been played.

    Args:
        evaluations: evaluations by what their volumes are called.
        has_total: whether all of them are put together too; not where some volumes were trained on and others not.
        facts: agent, data and settings of the evaluation, as plain values for the JSON file.
    """

    evaluations: Mapping[str, Evaluation]
    has_total: bool
    facts: Mapping[str, Any]

    @cached_property
    def by_split(self) -> dict[str, MetricEstimates]:
        """By what the volumes are called, and of all together under `all volumes`."""
        metrics = {label: MetricEstimates.of(evaluation) for label, evaluation in self.evaluations.items()}
        if self.has_total and len(metrics) > 1:
            everything = tuple(episode for each in self.evaluations.values() for episode in each.episodes)
            metrics[TOTAL] = MetricEstimates.of(Evaluation(everything))
        return metrics

    @cached_property
    def by_volume(self) -> dict[str, dict[str, MetricEstimates]]:
        """By what the volumes are called, then by the volume's name."""
        return {
            label: {name: MetricEstimates.of(each) for name, each in evaluation.by_volume().items()}
            for label, evaluation in self.evaluations.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON; what was not measured is None."""
        return {
            **self.facts,
            "intervals": {
                "level": LEVEL,
                "resamples": N_RESAMPLES,
                "method": "percentile bootstrap of volumes, then episodes",
            },
            "splits": {label: _plain(metrics) for label, metrics in self.by_split.items()},
            "volumes": {
                label: {name: _plain(metrics) for name, metrics in volumes.items()}
                for label, volumes in self.by_volume.items()
            },
            "episodes": {
                label: [asdict(episode) for episode in evaluation.episodes]
                for label, evaluation in self.evaluations.items()
            },
        }

    def metrics(self) -> dict[str, dict[str, float]]:
        """Return the numbers by what they are of: `test_volumes`, `volume/NAME`."""
        groups = {label.replace(" ", "_"): metrics.metrics() for label, metrics in self.by_split.items()}
        for volumes in self.by_volume.values():
            for name, metrics in volumes.items():
                groups[f"volume/{REFUSED_BY_MLFLOW.sub('_', name)}"] = metrics.metrics()
        return groups


def report_tables(report: EvaluationReport) -> list[Table]:
    """Return the table of the splits, and for each of them that of its volumes."""
    return [_summary(report.by_split), *(_by_volume(*each) for each in report.by_volume.items())]


def metrics_in_markdown(metrics: Mapping[str, MetricEstimates]) -> str:
    """Return the metrics by what their volumes are called, each with its interval, as a table in Markdown."""
    rows = [["metrics, with 95 % intervals", *metrics], ["---", *("---:" for _ in metrics)]]
    for text, key, form in SUMMARY_ROWS:
        cells = (_cell(_shown(each, key), form, apart=" (") for each in metrics.values())
        rows.append([text, *(f"{cell})" if "(" in cell else cell for cell in cells)])
    for text, count in COUNTS:
        rows.append([text, *(str(getattr(each, count)) for each in metrics.values())])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _summary(metrics: Mapping[str, MetricEstimates]) -> Table:
    table = Table(title="metrics, with 95 % intervals", title_justify="left")
    table.add_column("")
    for label in metrics:
        table.add_column(label, justify="right")
    apart = "\n" if len(metrics) > 1 else "  "
    for text, key, form in SUMMARY_ROWS:
        table.add_row(text, *(_cell(_shown(each, key), form, apart=apart) for each in metrics.values()))
        if key == "success_rate":
            wilson = (each.estimates["success_rate_wilson"] for each in metrics.values())
            table.add_row("  its interval by Wilson", *(_interval(estimate, form) for estimate in wilson))
    table.add_section()
    for text, count in COUNTS:
        table.add_row(text, *(str(getattr(each, count)) for each in metrics.values()))
    table.add_section()
    table.add_row("those not started solved:")
    for text, key, form in SUMMARY_ROWS[:N_ROWS_OF_THE_OTHERS]:
        others = (_shown(each, key + NOT_STARTED_SOLVED) for each in metrics.values())
        table.add_row(f"  {text}", *(_cell(estimate, form, apart=apart) for estimate in others))
    return table


def _by_volume(label: str, volumes: Mapping[str, MetricEstimates]) -> Table:
    table = Table(title=f"{label}, each", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("volume", overflow="fold")
    table.add_column("n", justify="right")
    for heading, _, _ in VOLUME_COLUMNS:
        table.add_column(heading, justify="right")
    for name, metrics in volumes.items():
        cells = (_cell(metrics.estimates[key], form, apart="\n") for _, key, form in VOLUME_COLUMNS)
        table.add_row(Text(name), str(metrics.n_episodes), *cells)
    return table


def _shown(metrics: MetricEstimates, key: str) -> Estimate:
    """Return a metric in the unit that it is shown in."""
    estimate = metrics.estimates[key]
    return Estimate(*(1000.0 * seconds for seconds in estimate)) if key == "mean_seconds_per_plane" else estimate


def _cell(estimate: Estimate, form: str, *, apart: str) -> str:
    if math.isnan(estimate.value):
        return "-"
    return f"{form.format(estimate.value)}{apart}{_interval(estimate, form)}"


def _interval(estimate: Estimate, form: str) -> str:
    low, high = form.format(estimate.low), form.format(estimate.high)
    # Of two percentages, one sign is enough; a dash between numbers below zero would be read as another minus.
    between = " to " if estimate.low < 0 else "–"
    return f"{low.removesuffix('%')}{between}{high}"


def _plain(metrics: MetricEstimates) -> dict[str, Any]:
    return {
        "volumes": metrics.n_volumes,
        "episodes": metrics.n_episodes,
        "episodes_started_solved": metrics.n_started_solved,
        "figures": {
            name: {key: None if math.isnan(number) else number for key, number in estimate._asdict().items()}
            for name, estimate in metrics.estimates.items()
        },
    }

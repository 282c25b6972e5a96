"""The report of an evaluation: metrics with intervals by split and by volume, as JSON, MLflow metrics and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from armscan.experiment.results import few_subjects
from armscan.stats.bootstrap import LEVEL, N_RESAMPLES, Estimate
from armscan.tracking.sanitize import name_of
from armscan.training import TRAINING, Evaluation, MetricEstimates, ResultTable
from armscan.training.baselines import AGENT, RANDOM
from armscan.training.episode_results import metric_prefix
from armscan.training.headline import ABOVE_RANDOM, beside_random, headline
from armscan.training.metric_display import interval_text
from armscan.training.metrics import LEAST_SURE, NOT_STARTED_SOLVED, SUREST
from armscan.utils.text import MISSING, formatted

TOTAL = "all volumes"
TIME = "mean_seconds_per_plane"
# Metrics for which the table of results has no room.
FURTHER_ROWS = (
    ("final reward, mean", "mean_final_reward", "{:.3f}"),
    ("best reward, mean", "mean_best_reward", "{:.3f}"),
    ("steps, median", "median_steps", "{:.1f}"),
    ("steps, 95th percentile", "p95_steps", "{:.1f}"),
    ("time per plane (ms), mean", TIME, "{:.2f}"),
)
# Metrics of agents that predict their own errors.
BY_EXPECTED_ERROR = tuple(
    (f"{title} of the {which} quarter, median", f"median_distance_{unit}{suffix}", "{:.2f}")
    for unit, title in (("mm", "distance mm"), ("deg", "angle °"))
    for which, suffix in (("surest", SUREST), ("least sure", LEAST_SURE))
)
OF_THE_OTHERS = (("success, by reward", "success_rate", "{:.1%}"), ("steps, mean", "mean_steps", "{:.2f}"))


@dataclass(frozen=True)
class EvaluationReport:
    """An evaluation that has been played.

    Args:
        evaluations: Evaluations by the name of their volumes, such as `test volumes`.
        has_total: Whether to pool all evaluations too; False unless they are new to the agent's run.
        facts: Agent, data and settings of the evaluation, as plain values for the JSON file.
        baselines: Episodes of the baselines, by their names, then by the name of the volumes. Default: none.
    """

    evaluations: Mapping[str, Evaluation]
    has_total: bool
    facts: Mapping[str, Any]
    baselines: Mapping[str, Mapping[str, Evaluation]] = field(default_factory=dict)

    @cached_property
    def by_split(self) -> dict[str, MetricEstimates]:
        """Return the metrics by the name of the volumes, and the pooled ones under `all volumes`."""
        played, randoms = self._with_total(self.evaluations), self._with_total(self.baselines.get(RANDOM, {}))
        return {
            label: beside_random(MetricEstimates.of(each), [each], randoms.get(label)) for label, each in played.items()
        }

    @cached_property
    def baselines_by_split(self) -> dict[str, dict[str, MetricEstimates]]:
        """Return the metrics of the baselines, without times, by the baseline's name, then as `by_split`."""
        return {
            name: {label: _untimed(MetricEstimates.of(each)) for label, each in self._with_total(evaluations).items()}
            for name, evaluations in self.baselines.items()
        }

    def tables(self) -> dict[str, ResultTable]:
        """Return the tables of agent and baselines, by the name of the volumes."""
        tables = {}
        for label, figures in self.by_split.items():
            # A run's own baselines play on the test volumes alone.
            baselines = {name: each[label] for name, each in self.baselines_by_split.items() if label in each}
            random = {AGENT: baselines[RANDOM]} if RANDOM in baselines else {}
            tables[label] = ResultTable({AGENT: figures, **baselines}, headline=headline({AGENT: figures}, random))
        return tables

    def notes(self, label: str) -> list[str]:
        """Return a note if a group of volumes has too few subjects; `facts` has the notes on the whole evaluation."""
        return [] if label == TRAINING else few_subjects({"": self.by_split[label]})

    def _with_total(self, evaluations: Mapping[str, Evaluation]) -> dict[str, Evaluation]:
        """Return evaluations by the name of their volumes, and the pooled one if there is a total."""
        if not self.has_total or len(evaluations) < 2:
            return dict(evaluations)
        return {**evaluations, TOTAL: Evaluation.pooled([*evaluations.values()])}

    @cached_property
    def by_volume(self) -> dict[str, dict[str, MetricEstimates]]:
        """Return the metrics by the name of the group of volumes, then by the volume's name."""
        return {
            label: {name: MetricEstimates.of(each) for name, each in evaluation.by_volume().items()}
            for label, evaluation in self.evaluations.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON; missing measurements are None."""
        return {
            **self.facts,
            "intervals": {
                "level": LEVEL,
                "resamples": N_RESAMPLES,
                "method": "percentile bootstrap of subjects, then episodes; rates of 0 and 1: Wilson; "
                f"{ABOVE_RANDOM}: Student's t over subjects, or Newcombe",
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
            "on_plane": [list(each) for each in next(iter(self.evaluations.values())).on_plane],
            "baselines": {
                name: {
                    "splits": {label: _plain(metrics) for label, metrics in self.baselines_by_split[name].items()},
                    "episodes": {label: list(map(asdict, each.episodes)) for label, each in evaluations.items()},
                }
                for name, evaluations in self.baselines.items()
            },
        }

    def metrics(self) -> dict[str, dict[str, float]]:
        """Return the metrics by their origin: `test_volumes`, `volume/NAME`, `BASELINE/test_volumes`."""
        groups = {metric_prefix(label): metrics.metrics() for label, metrics in self.by_split.items()}
        for volumes in self.by_volume.values():
            for name, metrics in volumes.items():
                groups[name_of(f"volume/{name}")] = metrics.metrics()
        shown = {label: [column.metric for column in table.quantities] for label, table in self.tables().items()}
        for name, by_split in self.baselines_by_split.items():
            for label, names in shown.items():
                groups[metric_prefix(f"{name}/{label}")] = by_split[label].shown_metrics(names)
        return groups


def assigned(changes: Mapping[str, Any]) -> list[str]:
    """Return changed rules as they are shown, such as `max_steps=3`."""
    return [f"{key}={value}" for key, value in changes.items()]


def report_tables(report: EvaluationReport, width: int) -> list[Table | Text]:
    """Return the tables to print besides the results: each volume of each group, and further figures.

    Args:
        report: Report to show.
        width: Width of the terminal, in characters.
    """
    parts: list[Table | Text] = []
    for label, volumes in report.by_volume.items():
        parts += [Text(f"{label}, each", style="italic"), *ResultTable(volumes).lines(width)]
    return [*parts, _further(report.by_split)]


def _further(metrics: Mapping[str, MetricEstimates]) -> Table:
    table = Table(title="further figures of the agent", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("")
    for label in metrics:
        table.add_column(label, justify="right")
    apart = "\n" if len(metrics) > 1 else "  "
    for text, key, form in FURTHER_ROWS:
        table.add_row(text, *(_cell(_shown(each, key), form, apart=apart) for each in metrics.values()))
    if any(key in each.estimates for _, key, _ in BY_EXPECTED_ERROR for each in metrics.values()):
        table.add_section()
        for text, key, form in BY_EXPECTED_ERROR:
            table.add_row(text, *(_cell(each.estimate(key), form, apart=apart) for each in metrics.values()))
    table.add_section()
    table.add_row("those not started solved:")
    for text, key, form in OF_THE_OTHERS:
        others = (_shown(each, key + NOT_STARTED_SOLVED) for each in metrics.values())
        table.add_row(f"  {text}", *(_cell(estimate, form, apart=apart) for estimate in others))
    return table


def _shown(metrics: MetricEstimates, key: str) -> Estimate:
    """Return a metric in the unit that it is shown in."""
    estimate = metrics.estimate(key)
    return Estimate(*(1000.0 * seconds for seconds in estimate)) if key == TIME else estimate


def _untimed(metrics: MetricEstimates) -> MetricEstimates:
    # Episodes of baselines may be from the cache, played under another load.
    return replace(metrics, estimates={name: each for name, each in metrics.estimates.items() if name != TIME})


def _cell(estimate: Estimate, form: str, *, apart: str) -> str:
    if math.isnan(estimate.value):
        return MISSING
    return f"{formatted(form, estimate.value)}{apart}{interval_text(estimate, form)}"


def _plain(metrics: MetricEstimates) -> dict[str, Any]:
    return {
        **metrics.counts,
        "figures": {
            name: {
                key: None if math.isnan(number) else number for key, number in metrics.estimate(name)._asdict().items()
            }
            for name in metrics.estimates
        },
    }

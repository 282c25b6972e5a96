"""Every number of a comparison, as rows of CSV files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from armscan.reports.charts import Curves
from armscan.reports.groups import Group
from armscan.reports.html import Row
from armscan.reports.load import TrackedTraining
from armscan.reports.significance import Pair, metrics_by_volume
from armscan.training import MetricEstimates


def all_numbers(
    groups: Sequence[Group],
    curves: Curves,
    reached: Sequence[MetricEstimates | None],
    pairs: Mapping[str, Sequence[Pair]],
    baselines: Mapping[str, MetricEstimates],
) -> dict[str, list[Row]]:
    """Return the tables by file name."""
    return {
        "runs": [_run_row(group, training) for group in groups for training in group.trainings],
        "curves": list(_curve_rows(groups, curves)),
        "seed_curves": list(_seed_rows(groups)),
        "final": list(_final_rows(groups, reached, baselines)),
        "final_by_volume": list(_volume_rows(groups)),
        "improvement": list(_pair_rows(groups, pairs)),
    }


def _run_row(group: Group, training: TrackedTraining) -> Row:
    return {
        "run": training.run_id,
        "name": training.name,
        "group": group.name,
        **_seed_and_fold(training),
        "status": training.status,
        "environment steps": "" if math.isnan(training.env_steps) else int(training.env_steps),
        "weights after, steps": "" if math.isnan(training.best_env_steps) else int(training.best_env_steps),
        "training, s": "" if math.isnan(training.wall_s) else training.wall_s,
        "not kept": ", ".join(training.missing),
    }


def _seed_and_fold(training: TrackedTraining) -> Row:
    return {"seed": training.seed or "", "fold": training.fold or ""}


def _curve_rows(groups: Sequence[Group], curves: Curves) -> Iterator[Row]:
    for (metric, axis, number), curve in curves.items():
        of_curve = {"group": groups[number].name, "metric": metric, "axis": axis, "seeds": curve.n_seeds}
        for place, value, low, high in zip(curve.places, *curve.band, strict=True):
            yield {**of_curve, "place": place, "value": value, "low": low, "high": high}


def _seed_rows(groups: Sequence[Group]) -> Iterator[Row]:
    for group in groups:
        for training in group.trainings:
            for metric, series in training.series.items():
                of_training = {"group": group.name, "run": training.run_id, **_seed_and_fold(training)}
                of_series = {**of_training, "metric": metric}
                for env_steps, wall_s, value in zip(series.env_steps, series.wall_s, series.values, strict=True):
                    yield {**of_series, "env_steps": int(env_steps), "wall_s": wall_s, "value": value}


def _final_rows(
    groups: Sequence[Group], reached: Sequence[MetricEstimates | None], baselines: Mapping[str, MetricEstimates]
) -> Iterator[Row]:
    names = (*(group.name for group in groups), *baselines)
    for of, metrics in zip(names, (*reached, *baselines.values()), strict=True):
        if metrics is None:
            continue
        for name in metrics.estimates:
            yield {"group": of, "seeds": metrics.n_seeds, "metric": name, **metrics.estimate(name)._asdict()}


def _volume_rows(groups: Sequence[Group]) -> Iterator[Row]:
    for group in groups:
        for training in group.trainings:
            for volume, metrics in metrics_by_volume(training).items():
                of_training = {"group": group.name, "run": training.run_id, **_seed_and_fold(training)}
                yield {**of_training, "volume": volume, **metrics}


def _pair_rows(groups: Sequence[Group], pairs: Mapping[str, Sequence[Pair]]) -> Iterator[Row]:
    for metric, of_metric in pairs.items():
        for pair in of_metric:
            if pair.probability is not None:
                names = {"better": groups[pair.ours].name, "than": groups[pair.theirs].name}
                yield {"metric": metric, **names, **pair.probability._asdict()}

"""Final metrics of groups on their test volumes, and the probability that one group is better than another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from armscan.reports.groups import Group
from armscan.reports.load import TrackedTraining
from armscan.stats.aggregation import probability_of_improvement
from armscan.stats.bootstrap import Estimate
from armscan.training import MetricEstimates
from armscan.volumes.plane import FloatArray

# Rate of the leading limits, and metrics of `Evaluation.metrics`, that groups are compared by; true where higher is
# better.
COMPARED_BY = {"on_plane_rate": True, "median_distance_mm": False, "success_rate": True, "mean_steps": False}


@dataclass(frozen=True)
class Pair:
    """Comparison of two groups by one metric.

    Args:
        ours: Index of the first group.
        theirs: Index of the second group.
        probability: Probability that a training of the first group is better than one of the second; None if they were
            evaluated on different volumes.
    """

    ours: int
    theirs: int
    probability: Estimate | None


def evaluated_trainings(group: Group) -> list[TrackedTraining]:
    """Return the trainings of a group that have a final evaluation."""
    return [training for training in group.trainings if training.evaluation is not None]


def final_metrics(group: Group) -> MetricEstimates | None:
    """Return the final metrics of a group, with intervals over seeds, volumes and episodes; None if not evaluated."""
    played = {each.run_id: each.evaluation for each in group.trainings if each.evaluation is not None}
    return MetricEstimates.of_trainings(played) if played else None


def compare_groups(groups: Sequence[Group], figure: str) -> Iterator[Pair]:
    """Yield the comparison of every pair of groups that were evaluated.

    Args:
        groups: Groups of trainings, in the order of their indices.
        figure: Name of the metric, one of `COMPARED_BY`.
    """
    volumes = [_volumes(group) for group in groups]
    scores = [_scores(group, figure) * (1.0 if COMPARED_BY[figure] else -1.0) for group in groups]
    for ours, theirs in combinations(range(len(groups)), 2):
        if not (evaluated_trainings(groups[ours]) and evaluated_trainings(groups[theirs])):
            continue
        is_comparable = _are_same(volumes[ours], volumes[theirs])
        yield Pair(ours, theirs, probability_of_improvement(scores[ours], scores[theirs]) if is_comparable else None)


def complement(probability: Estimate) -> Estimate:
    """Return the probability that the second group is better than the first."""
    return Estimate(1.0 - probability.value, 1.0 - probability.high, 1.0 - probability.low)


def metrics_by_volume(training: TrackedTraining) -> dict[str, dict[str, float]]:
    """Return the final metrics of a training by test volume; empty without a final evaluation."""
    if training.evaluation is None:
        return {}
    return {name: each.metrics() for name, each in sorted(training.evaluation.by_volume().items())}


def baseline_metrics(group: Group) -> dict[str, MetricEstimates]:
    """Return the metrics of the baselines on the test volumes of a group, by their names; its trainings have the same.

    The baselines are not trained, and play the same episodes for every seed.
    """
    kept = next((training.baselines for training in group.trainings if training.baselines), {})
    return {name: MetricEstimates.of(evaluation) for name, evaluation in kept.items()}


def _scores(group: Group, figure: str) -> FloatArray:
    """Return a metric of the group's trainings, shape (seeds, volumes), on the volumes that all of them share."""
    rows = [_compared(training) for training in evaluated_trainings(group)]
    common = sorted(set.intersection(*(set(row) for row in rows))) if rows else []
    return np.array([[row[volume][figure] for volume in common] for row in rows])


def _compared(training: TrackedTraining) -> dict[str, dict[str, float]]:
    by_volume = training.evaluation.by_volume() if training.evaluation else {}
    return {name: each.metrics() | {"on_plane_rate": each.on_plane_rate} for name, each in by_volume.items()}


def _volumes(group: Group) -> Mapping[str, str | None] | None:
    """Return the volumes that a group was evaluated on, with fingerprints; None if its trainings differ."""
    of_trainings = [
        {name: (training.volumes or {}).get(name) for name in metrics_by_volume(training)}
        for training in evaluated_trainings(group)
    ]
    is_one = all(_are_same(of_trainings[0], each) for each in of_trainings[1:])
    return of_trainings[0] if of_trainings and is_one else None


def _are_same(some: Mapping[str, str | None] | None, others: Mapping[str, str | None] | None) -> bool:
    """Return whether volumes have the same names, and the same fingerprints where both are known."""
    if some is None or others is None or some.keys() != others.keys():
        return False
    return all(None in (some[name], others[name]) or some[name] == others[name] for name in some)

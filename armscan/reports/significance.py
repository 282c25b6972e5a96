"""Final metrics of groups on their test volumes, and the probability that one group is better than another."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np

from armscan.reports.groups import Group
from armscan.reports.load import TrackedTraining
from armscan.stats.aggregation import probabilities_of_improvement, probability_of_improvement
from armscan.stats.bootstrap import Estimate
from armscan.training import Evaluation, MetricEstimates
from armscan.training.baselines import RANDOM
from armscan.training.headline import beside_random
from armscan.utils.arrays import FloatArray

# Metrics that groups are compared by: the leading on-plane rate, and others of `Evaluation.metrics`; true if higher is
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


def evaluations_by_seed(group: Group) -> dict[str, Evaluation]:
    """Return the final evaluations of a group by seed; the folds of a seed are pooled, so each wrist counts once."""
    played: dict[str, list[Evaluation]] = defaultdict(list)
    for training in group.tested:
        assert training.evaluation is not None
        played[training.seed_key].append(training.evaluation)
    return {seed: Evaluation.pooled(evaluations) for seed, evaluations in played.items()}


def final_metrics(group: Group) -> MetricEstimates | None:
    """Return the final metrics of a group, with intervals over seeds, subjects and episodes; None if not evaluated."""
    played, random = evaluations_by_seed(group), _baselines(group).get(RANDOM)
    if not played:
        return None
    return beside_random(
        MetricEstimates.of_trainings(played), [*played.values()], Evaluation.pooled(random) if random else None
    )


def compare_groups(groups: Sequence[Group]) -> dict[str, list[Pair]]:
    """Return the comparison of every pair of groups that were evaluated, by each metric of `COMPARED_BY`."""
    volumes = [_volumes(group) for group in groups]
    metrics = [[_compared(each) for each in evaluations_by_seed(group).values()] for group in groups]
    pairs = list(combinations([number for number, of_group in enumerate(metrics) if of_group], 2))
    comparable = [pair for pair in pairs if _are_same(*(volumes[number] for number in pair))]
    compared = {}
    for metric, is_higher_better in COMPARED_BY.items():
        scores = [_scores(of_group, metric) * (1.0 if is_higher_better else -1.0) for of_group in metrics]
        found = probabilities_of_improvement([(scores[ours], scores[theirs]) for ours, theirs in comparable])
        known = dict(zip(comparable, found, strict=True))
        compared[metric] = [Pair(*pair, known.get(pair)) for pair in pairs]
    return compared


@cache
def can_differ(n_ours: int, n_theirs: int) -> bool:
    """Return whether groups with so many seeds can be told apart, if all of one are better than all of the other."""
    return probability_of_improvement(np.ones((n_ours, 1)), np.zeros((n_theirs, 1))).low > 0.5


def have_same_volumes(groups: Sequence[Group]) -> bool:
    """Return whether all groups were evaluated on the same volumes."""
    volumes = [_volumes(group) for group in groups if group.tested]
    return all(_are_same(volumes[0], each) for each in volumes)


def complement(probability: Estimate) -> Estimate:
    """Return the probability that the second group is better than the first."""
    return Estimate(1.0 - probability.value, 1.0 - probability.high, 1.0 - probability.low)


def metrics_by_volume(training: TrackedTraining) -> dict[str, dict[str, float]]:
    """Return the final metrics of a training by test volume; empty without a final evaluation."""
    if training.evaluation is None:
        return {}
    return {name: each.metrics() for name, each in sorted(training.evaluation.by_volume().items())}


def baseline_metrics(groups: Sequence[Group]) -> list[dict[str, MetricEstimates]]:
    """Return the metrics of the baselines, by name, on the test volumes of each group.

    The baselines are not trained, and play the same episodes for every seed, and for all groups that were evaluated on
    the same volumes by the same rules.
    """
    metrics = cache(MetricEstimates.of)
    return [{name: metrics(Evaluation.pooled(each)) for name, each in _baselines(group).items()} for group in groups]


def _baselines(group: Group) -> dict[str, list[Evaluation]]:
    """Return the baselines' evaluations by name, one for each fold; none if its seeds had different test volumes."""
    if _volumes(group) is None:
        return {}
    # In the order of a grid's own table, so that intervals are the same.
    tested = sorted(group.tested, key=lambda each: (len(each.fold or ""), each.fold or ""), reverse=True)
    of_fold = {each.fold: each.baselines for each in reversed(tested) if each.baselines}
    names = dict.fromkeys(name for baselines in of_fold.values() for name in baselines)
    return {name: [each[name] for each in of_fold.values() if name in each] for name in names}


def _scores(trainings: Sequence[Mapping[str, Mapping[str, float]]], metric: str) -> FloatArray:
    """Return a metric of trainings, shape (seeds, volumes), on the volumes that all of them share."""
    common = sorted(set.intersection(*map(set, trainings))) if trainings else []
    return np.array([[training[volume][metric] for volume in common] for training in trainings])


def _compared(evaluation: Evaluation) -> dict[str, dict[str, float]]:
    by_volume = evaluation.by_volume()
    return {name: each.metrics() | {"on_plane_rate": each.on_plane_rate} for name, each in by_volume.items()}


def _volumes(group: Group) -> Mapping[str, str | None] | None:
    """Return the volumes that a group was evaluated on, with fingerprints; None if its seeds differ."""
    of_seeds: dict[str, dict[str, str | None]] = defaultdict(dict)
    for training in group.tested:
        assert training.evaluation is not None
        known = (training.volumes or {}).get("test", {})
        prints = {name: known.get(name) for name in training.evaluation.by_volume()}
        of_seeds[training.seed_key] |= prints
    first, *others = of_seeds.values() or [None]
    return first if all(_are_same(first, each) for each in others) else None


def _are_same(some: Mapping[str, str | None] | None, others: Mapping[str, str | None] | None) -> bool:
    """Return whether volumes have the same names, and the same fingerprints where both are known."""
    if some is None or others is None or some.keys() != others.keys():
        return False
    return all(None in (some[name], others[name]) or some[name] == others[name] for name in some)

"""What groups have reached on their test volumes, and which of two is likely to be the better."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from armscan.reports.groups import Group
from armscan.reports.trainings import Training
from armscan.training import Evaluation, Figures
from armscan.training.bootstrap import Estimate
from armscan.training.seeds import probability_of_improvement
from armscan.volumes.plane import FloatArray

# What groups are compared by: the figures of `Evaluation.metrics`, and whether more of it is better.
COMPARED_BY = {"mean_steps": False, "success_rate": True, "mean_distance_mm": False}


@dataclass(frozen=True)
class Pair:
    """Two groups compared by a figure.

    Args:
        ours: number of the one group.
        theirs: number of the other.
        probability: that a training of ours is better than one of theirs; None where they were judged on other volumes.
        stratified: likewise, with the interval that draws the seeds of each volume by itself.
    """

    ours: int
    theirs: int
    probability: Estimate | None
    stratified: Estimate | None


def judged(group: Group) -> list[Training]:
    """Returns the trainings of a group that have a final evaluation."""
    return [training for training in group.trainings if training.evaluation is not None]


def final_figures(group: Group) -> Figures | None:
    """Returns what a group has reached, with intervals of seeds, volumes and episodes; None where none was judged."""
    played = [(training.run_id, training.evaluation) for training in judged(group) if training.evaluation is not None]
    if not played:
        return None
    episodes = [(run_id, episode) for run_id, evaluation in played for episode in evaluation.episodes]
    of_runs, of_all = zip(*episodes, strict=True)
    return Figures.of(Evaluation(of_all), of_runs)


def compared(groups: Sequence[Group], figure: str) -> Iterator[Pair]:
    """Yields every pair of groups that were judged, compared by a figure.

    Args:
        groups: in their order.
        figure: one of `COMPARED_BY`.
    """
    is_more_better = COMPARED_BY[figure]
    volumes = [_volumes(group) for group in groups]
    scores = [_scores(group, figure) * (1.0 if is_more_better else -1.0) for group in groups]
    for ours, theirs in combinations(range(len(groups)), 2):
        if not (judged(groups[ours]) and judged(groups[theirs])):
            continue
        if _are_same(volumes[ours], volumes[theirs]):
            both = scores[ours], scores[theirs]
            stratified = probability_of_improvement(*both, is_stratified=True)
            yield Pair(ours, theirs, probability_of_improvement(*both), stratified)
        else:
            yield Pair(ours, theirs, None, None)


def opposite(probability: Estimate) -> Estimate:
    """Returns the probability that theirs is better than ours."""
    return Estimate(1.0 - probability.value, 1.0 - probability.high, 1.0 - probability.low)


def volume_figures(training: Training) -> dict[str, dict[str, float]]:
    """Returns the figures of a training's final evaluation by test volume; none where it has none."""
    if training.evaluation is None:
        return {}
    return {name: each.metrics() for name, each in sorted(training.evaluation.by_volume().items())}


def _scores(group: Group, figure: str) -> FloatArray:
    """Returns a figure of the group's trainings, shape (seeds, volumes), for the volumes that all of them have."""
    rows = [volume_figures(training) for training in judged(group)]
    common = sorted(set.intersection(*(set(row) for row in rows))) if rows else []
    return np.array([[row[volume][figure] for volume in common] for row in rows])


def _volumes(group: Group) -> Mapping[str, str | None] | None:
    """Returns the volumes that a group was judged on, with their fingerprints; None where its trainings differ."""
    of_trainings = [
        {name: (training.volumes or {}).get(name) for name in volume_figures(training)} for training in judged(group)
    ]
    is_one = all(_are_same(of_trainings[0], each) for each in of_trainings[1:])
    return of_trainings[0] if of_trainings and is_one else None


def _are_same(some: Mapping[str, str | None] | None, others: Mapping[str, str | None] | None) -> bool:
    """Whether volumes are the same: by their names, and by their fingerprints where both are known."""
    if some is None or others is None or some.keys() != others.keys():
        return False
    return all(None in (some[name], others[name]) or some[name] == others[name] for name in some)

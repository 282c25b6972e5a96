"""Metrics over episodes, each with its confidence interval."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from armscan.stats.bootstrap import Estimate, Statistic, estimates, mean, quantile, wilson
from armscan.training.rollout import MEANS, Evaluation

# Suffix of metrics over the episodes that did not start solved.
NOT_STARTED_SOLVED = "_not_started_solved"
MEDIAN, P95 = quantile(0.5), quantile(0.95)

# By name, the statistic, and what of an episode it is of.
METRICS: dict[str, tuple[Statistic, str]] = {
    **{name: (mean, value) for name, value in MEANS.items()},
    "median_steps": (MEDIAN, "n_steps"),
    "p95_steps": (P95, "n_steps"),
    "median_distance_mm": (MEDIAN, "distance_mm"),
    "median_distance_deg": (MEDIAN, "distance_deg"),
    **{f"mean_{value}": (mean, value) for value in ("dice_bones", "dice_tendons", "dice_artery", "seconds_per_plane")},
}


@dataclass(frozen=True)
class MetricEstimates:
    """Sums and means over some episodes.

    Args:
        n_volumes: number of volumes that they are on.
        n_episodes: number of episodes.
        n_started_solved: number of those that started on a rewarded plane.
        estimates: metrics by name, over all episodes; those whose names end with `_not_started_solved` over the others
            only. `success_rate_wilson` is the success rate with Wilson's interval.
    """

    n_volumes: int
    n_episodes: int
    n_started_solved: int
    estimates: dict[str, Estimate]

    @classmethod
    def of(cls, evaluation: Evaluation, trainings: Sequence[Hashable] | None = None) -> MetricEstimates:
        """Compute them; the same episodes give the same intervals.

        Args:
            evaluation: the episodes.
            trainings: training of each episode; None if all are of one.
        """
        episodes = evaluation.episodes
        volumes = [episode.volume for episode in episodes]
        are_solved = [episode.starts_solved for episode in episodes]
        columns: dict[str, tuple[Statistic, list[float]]] = {}
        for name, (statistic, value) in METRICS.items():
            values = [float(getattr(episode, value)) for episode in episodes]
            columns[name] = statistic, values
            of_others = np.where(are_solved, math.nan, values).tolist()
            columns[name + NOT_STARTED_SOLVED] = statistic, of_others
        others = [episode for episode in episodes if not episode.starts_solved]
        return cls(
            n_volumes=len(set(volumes)),
            n_episodes=len(episodes),
            n_started_solved=len(episodes) - len(others),
            estimates=estimates(columns, volumes, trainings=trainings)
            | {
                f"success_rate_wilson{suffix}": wilson(sum(episode.is_success for episode in some), len(some))
                for suffix, some in (("", episodes), (NOT_STARTED_SOLVED, others))
            },
        )

    def metrics(self) -> dict[str, float]:
        """Return all numbers by name, the ends of an interval as `..._low` and `..._high`."""
        metrics: dict[str, float] = {
            "volumes": self.n_volumes,
            "episodes": self.n_episodes,
            "episodes_started_solved": self.n_started_solved,
        }
        for name, (value, low, high) in self.estimates.items():
            metrics |= {name: value, f"{name}_low": low, f"{name}_high": high}
        return metrics

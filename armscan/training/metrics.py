"""Metrics over episodes, each with its confidence interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

from armscan.stats.bootstrap import Estimate, Statistic, estimates, mean, quantile, wilson
from armscan.training.rollout import EpisodeResult, Evaluation

# Suffix of metrics over the episodes that did not start solved.
NOT_STARTED_SOLVED = "_not_started_solved"
MEDIAN, P95 = quantile(0.5), quantile(0.95)

METRICS: dict[str, tuple[Statistic, Callable[[EpisodeResult], float]]] = {
    "success_rate": (mean, lambda episode: episode.is_success),
    "mean_steps": (mean, lambda episode: episode.n_steps),
    "median_steps": (MEDIAN, lambda episode: episode.n_steps),
    "p95_steps": (P95, lambda episode: episode.n_steps),
    "mean_return": (mean, lambda episode: episode.episode_return),
    "mean_final_reward": (mean, lambda episode: episode.final_reward),
    "mean_best_reward": (mean, lambda episode: episode.best_reward),
    "mean_distance_mm": (mean, lambda episode: episode.distance_mm),
    "median_distance_mm": (MEDIAN, lambda episode: episode.distance_mm),
    "mean_distance_deg": (mean, lambda episode: episode.distance_deg),
    "median_distance_deg": (MEDIAN, lambda episode: episode.distance_deg),
    "mean_dice": (mean, lambda episode: episode.mean_dice),
    "mean_dice_bones": (mean, lambda episode: episode.dice_bones),
    "mean_dice_tendons": (mean, lambda episode: episode.dice_tendons),
    "mean_dice_artery": (mean, lambda episode: episode.dice_artery),
    "mean_seconds_per_plane": (mean, lambda episode: episode.seconds_per_plane),
}


@dataclass(frozen=True)
class MetricEstimates:
    """What some episodes add up to.

    Args:
        n_volumes: that they are on.
        n_episodes: how many they are.
        n_started_solved: how many of them started on a rewarded plane.
        estimates: by name, over all episodes; those whose names end with `_not_started_solved` over the others only.
            `success_rate_wilson` is the success rate with Wilson's interval.
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
            trainings: which training each episode is of; None where all are of one.
        """
        episodes = evaluation.episodes
        volumes = [episode.volume for episode in episodes]
        columns: dict[str, tuple[Statistic, list[float]]] = {}
        for name, (statistic, value) in METRICS.items():
            columns[name] = statistic, [value(episode) for episode in episodes]
            columns[name + NOT_STARTED_SOLVED] = (
                statistic,
                [math.nan if episode.starts_solved else value(episode) for episode in episodes],
            )
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

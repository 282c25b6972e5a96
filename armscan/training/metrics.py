"""Metrics over episodes, each with its confidence interval."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np

from armscan.stats.bootstrap import UNKNOWN, Estimate, Statistic, estimates, interquartile_mean, mean, quantile
from armscan.stats.on_plane import OnPlane, limits_among
from armscan.stats.proportions import wilson
from armscan.training.episode_results import MEANS, EpisodeResult, Evaluation

# Suffix of metrics over the episodes that did not start solved, and of rates with Wilson's interval.
NOT_STARTED_SOLVED, WILSON = "_not_started_solved", "_wilson"
# Suffixes of errors over the episodes with the smallest and with the largest expected errors.
SUREST, LEAST_SURE = "_surest_quarter", "_least_sure_quarter"
# Suffixes of the ends of an interval, and the names of the counts.
ENDS = ("_low", "_high")
COUNTS = ("volumes", "subjects", "episodes", "episodes_started_solved")
# Tracked if there are several.
SEEDS = "seeds"
# `NERVE_SHOWN`, the share of episodes whose labelled plane shows the nerve, is reported only if it is below 1.
NERVE_ERROR, NERVE_SHOWN = "nerve_area_error_mm2", "nerve_shown_rate"
MEDIAN, P90, P95 = quantile(0.5), quantile(0.9), quantile(0.95)

# Metrics by name: the statistic, and the value of an episode that it summarises.
METRICS: dict[str, tuple[Statistic, str]] = {
    **{name: (mean, value) for name, value in MEANS.items()},
    "iqm_steps": (interquartile_mean, "n_steps"),
    "median_steps": (MEDIAN, "n_steps"),
    "p95_steps": (P95, "n_steps"),
    **{f"median_{value}": (MEDIAN, value) for value in ("distance_mm", "distance_deg")},
    **{f"p90_{value}": (P90, value) for value in ("distance_mm", "distance_deg")},
    **{
        f"{name}_{value}": (statistic, value)
        for value in ("nerve_area_error_mm2", "nerve_area_error_percent")
        for name, statistic in (("median", MEDIAN), ("p90", P90))
    },
    **{f"median_{value}": (MEDIAN, value) for value in ("expected_mm", "expected_deg")},
    **{f"mean_{value}": (mean, value) for value in ("dice_bones", "dice_tendons", "dice_artery", "seconds_per_plane")},
}


@dataclass(frozen=True)
class MetricEstimates:
    """Metrics over some episodes, with their intervals.

    Args:
        n_seeds: Number of trainings that they summarise.
        n_volumes: Number of volumes that they summarise.
        n_subjects: Number of their subjects, which intervals resample.
        n_episodes: Number of episodes.
        n_started_solved: Number of episodes whose first plane would already be a success.
        estimates: Metrics by name, over all episodes. Those whose names end with `_not_started_solved` are over the
            others only; those that end with `_wilson` are rates with Wilson's interval.
        on_plane: Limits of the on-plane rates, the leading ones first.
    """

    n_seeds: int
    n_volumes: int
    n_subjects: int
    n_episodes: int
    n_started_solved: int
    estimates: Mapping[str, Estimate]
    on_plane: tuple[OnPlane, ...]

    @classmethod
    def of(cls, evaluation: Evaluation, trainings: Sequence[Hashable] | None = None) -> MetricEstimates:
        """Compute the metrics; the same episodes give the same intervals.

        Args:
            evaluation: Episodes to summarise.
            trainings: Training of each episode; None if all are from one.
        """
        episodes = evaluation.episodes
        subject_of = evaluation.subject_of
        is_other = [not episode.starts_solved for episode in episodes]
        rates = {"success_rate": [float(episode.is_success) for episode in episodes]}
        for limits in evaluation.on_plane:
            rates[limits.metric] = [float(limits.holds(each.distance_mm, each.distance_deg)) for each in episodes]
        columns: dict[str, tuple[Statistic, list[float]]] = {name: (mean, values) for name, values in rates.items()}
        for name, (statistic, value) in METRICS.items():
            measured = [getattr(episode, value) for episode in episodes]
            # Skip what was never measured.
            if any(each is not None for each in measured):
                columns[name] = statistic, [math.nan if each is None else float(each) for each in measured]
                if None in measured and value == NERVE_ERROR:
                    columns[NERVE_SHOWN] = mean, [float(each is not None) for each in measured]
        columns |= _by_expected_error(episodes)
        for name, (statistic, values) in list(columns.items()):
            columns[name + NOT_STARTED_SOLVED] = statistic, np.where(is_other, values, math.nan).tolist()
        wilsons = {}
        for name, values in rates.items():
            of_others = list(compress(values, is_other))
            wilsons[name + WILSON] = wilson(int(sum(values)), len(values))
            wilsons[name + NOT_STARTED_SOLVED + WILSON] = wilson(int(sum(of_others)), len(of_others))
        return cls(
            n_seeds=1 if trainings is None else len(set(trainings)),
            n_volumes=len(subject_of),
            n_subjects=len(set(subject_of.values())),
            n_episodes=len(episodes),
            n_started_solved=len(episodes) - sum(is_other),
            estimates=estimates(columns, [subject_of[each.volume] for each in episodes], trainings=trainings) | wilsons,
            on_plane=evaluation.on_plane,
        )

    @classmethod
    def of_trainings(cls, evaluations: Mapping[Any, Evaluation]) -> MetricEstimates:
        """Compute the metrics over the episodes of several trainings.

        Args:
            evaluations: Episodes of each training, by its name; one training or more.
        """
        played = [(training, each) for training, evaluation in evaluations.items() for each in evaluation.episodes]
        trainings, episodes = zip(*played, strict=True)
        first = next(iter(evaluations.values()))
        return cls.of(Evaluation(episodes, first.on_plane), trainings)

    @classmethod
    def of_metrics(cls, metrics: Mapping[str, float]) -> MetricEstimates:
        """Return estimates from the numbers of `metrics` or of a run; without an interval if its ends are missing."""
        ends = {name + end for name in metrics for end in ENDS if name + end in metrics}
        n_volumes, n_subjects, n_episodes, n_solved = (int(metrics.get(name, 0)) for name in COUNTS)
        n_seeds = int(metrics.get(SEEDS, 1))
        found = {
            name: Estimate(value, *(metrics.get(name + end, math.nan) for end in ENDS))
            for name, value in metrics.items()
            if name not in ends and name not in (*COUNTS, SEEDS)
        }
        return cls(n_seeds, n_volumes, n_subjects, n_episodes, n_solved, found, limits_among(found))

    def estimate(self, name: str) -> Estimate:
        """Return a figure as it is shown: NaN if there is none; with Wilson's interval if all episodes are equal."""
        estimate = self.estimates.get(name, UNKNOWN)
        are_equal = not estimate.has_width and math.isfinite(estimate.low)
        return self.estimates.get(name + WILSON, estimate) if are_equal else estimate

    def metrics(self) -> dict[str, float]:
        """Return all numbers by name as they are shown, the ends of an interval as `..._low` and `..._high`."""
        return self.shown_metrics(self.estimates)

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of volumes, subjects and episodes, by `COUNTS`."""
        counts = (self.n_volumes, self.n_subjects, self.n_episodes, self.n_started_solved)
        return dict(zip(COUNTS, counts, strict=True))

    def shown_metrics(self, names: Iterable[str]) -> dict[str, float]:
        """Return the numbers of these figures as they are shown; see `metrics`."""
        metrics: dict[str, float] = {**self.counts, **({SEEDS: self.n_seeds} if self.n_seeds > 1 else {})}
        for name in names:
            metrics |= dict(zip((name, *(name + end for end in ENDS)), self.estimate(name), strict=True))
        return metrics


def _by_expected_error(episodes: Sequence[EpisodeResult]) -> dict[str, tuple[Statistic, list[float]]]:
    """Return the errors over the quarters of episodes with the smallest and largest expected errors; {} if unknown."""
    columns: dict[str, tuple[Statistic, list[float]]] = {}
    for unit in ("mm", "deg"):
        expected = [getattr(episode, f"expected_{unit}") for episode in episodes]
        if not expected or None in expected:
            return {}
        order = np.argsort(expected, kind="stable")
        n_quarter = math.ceil(len(order) / 4)
        for which, chosen in ((SUREST, order[:n_quarter]), (LEAST_SURE, order[-n_quarter:])):
            values = np.full(len(order), math.nan)
            values[chosen] = [getattr(episodes[index], f"distance_{unit}") for index in chosen]
            columns[f"median_distance_{unit}{which}"] = MEDIAN, values.tolist()
    return columns

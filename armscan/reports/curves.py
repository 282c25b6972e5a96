"""Learning curves of a group: its seeds side by side, and their mean."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armscan.reports.groups import Group, of_common_folds
from armscan.reports.load import Series, TrackedTraining
from armscan.stats.aggregation import Band, band_over_seeds
from armscan.training.metric_display import bounds_of
from armscan.utils.arrays import FloatArray

# The horizontal axes of curves, and where a series has their values.
AXES: dict[str, Callable[[Series], FloatArray]] = {
    "environment steps": lambda series: series.env_steps,
    "seconds of training": lambda series: series.wall_s,
}
MAX_POINTS = 200


@dataclass(frozen=True)
class Curve:
    """A metric of a group over an axis.

    Args:
        places: Positions on the axis, ascending.
        band: Mean and interval over the seeds at these positions.
        n_seeds: Number of its seeds.
        lines: Line of each seed and fold, by its label: positions and values, as measured.
    """

    places: FloatArray
    band: Band
    n_seeds: int
    lines: dict[str, tuple[FloatArray, FloatArray]]


NOTHING = Curve(np.empty(0), Band(*[np.empty(0)] * 3), 0, {})
"""Placeholder where no training has measured the metric over an axis."""


def curve_of(group: Group, metric: str, axis: str) -> Curve | None:
    """Return the curve of a group; None if none of its trainings has measured the metric.

    Values are interpolated linearly between validations. A training that has ended keeps its last value while others of
    its group continue. Where one was cut off, or its metric became NaN, the curve ends. It begins where all have
    measured a value.

    Args:
        group: Group of the curve.
        metric: Name of the metric.
        axis: Name of the axis, a key of `AXES`.
    """
    trainings = of_common_folds(training for training in group.trainings if metric in training.series)
    lines = [_line(training.series[metric], axis) for training in trainings]
    known = [(training, line) for training, line in zip(trainings, lines, strict=True) if len(line[0])]
    if not known:
        return None
    places = _places(known, axis)
    of_seeds: dict[str, list[FloatArray]] = defaultdict(list)
    for training, line in known:
        of_seeds[training.seed_key].append(np.interp(places, *line))
    # The folds of a seed count as one seed.
    values, *ends = band_over_seeds(np.array([np.mean(each, axis=0) for each in of_seeds.values()]))
    band = Band(values, *np.clip(ends, *bounds_of(metric)))
    return Curve(places, band, len(of_seeds), {training.label: line for training, line in known})


def _line(series: Series, axis: str) -> tuple[FloatArray, FloatArray]:
    places = AXES[axis](series)
    is_known = np.isfinite(places) & np.isfinite(series.values)
    return places[is_known], series.values[is_known]


def _is_kept(training: TrackedTraining, end: float, axis: str) -> bool:
    """Return whether a metric that ends here keeps its last value: the training was whole, and measured it to its end.

    NaN, as of a diverged training, is not tracked.
    """
    ends = [AXES[axis](series)[-1] for series in training.series.values()]
    return training.is_whole and end >= np.nanmax(ends)


def _places(known: Sequence[tuple[TrackedTraining, tuple[FloatArray, FloatArray]]], axis: str) -> FloatArray:
    first = max(line[0][0] for _, line in known)
    last = max(line[0][-1] for _, line in known)
    last = min([last, *(line[0][-1] for training, line in known if not _is_kept(training, line[0][-1], axis))])
    places = np.unique(np.concatenate([line[0] for _, line in known]))
    places = places[(places >= first) & (places <= last)]
    return places if len(places) <= MAX_POINTS else np.linspace(places[0], places[-1], MAX_POINTS)

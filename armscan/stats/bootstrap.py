"""Percentile bootstrap intervals of episodes that are grouped by subject, the person that a volume is of.

An interval is for *other* subjects, and episodes on one subject are alike. So a resample draws subjects with
replacement, then as many episodes of each drawn subject as it has, also with replacement. With one subject this is a
bootstrap of its episodes, and describes that subject only. With several *seeds* of a training, a resample draws the
seeds first; all drawn seeds share the drawn subjects, as all seeds were evaluated on the same volumes.

With K subjects, the interval is a little too wide if subjects are alike. If they differ, it is too narrow, by about
sqrt((K - 1) / K) and more for small K: no resampling knows subjects that it has never seen. If every episode has the
same value, as at a success rate of 100 %, it has no width; `wilson` (`proportions.py`) then gives one, for independent
episodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armscan.errors import InvalidValueError
from armscan.utils.arrays import FloatArray

LEVEL = 0.95
# Quantiles at the ends of an interval.
LOWER, UPPER = (1 - LEVEL) / 2, (1 + LEVEL) / 2
N_RESAMPLES = 2000
# Maximum number of resampled values in memory at once.
MAX_VALUES = 2_000_000

Statistic = Callable[[FloatArray], FloatArray]


class Estimate(NamedTuple):
    """A figure with its 95 % confidence interval; all NaN if nothing was measured."""

    value: float
    low: float
    high: float

    @property
    def has_width(self) -> bool:
        """Whether it has an interval whose ends differ by more than rounding."""
        return math.isfinite(self.low) and not math.isclose(self.low, self.high, rel_tol=1e-9, abs_tol=1e-12)

    @property
    def if_wide(self) -> Estimate:
        """The estimate; its interval is NaN if it has no width."""
        return self if self.has_width else Estimate(self.value, math.nan, math.nan)

    @classmethod
    def around(cls, mean: Any, half_width: Any) -> Estimate:
        """Return a mean with a symmetric interval, which is NaN if `half_width` is."""
        return cls(float(mean), float(mean - half_width), float(mean + half_width))

    def clipped(self, least: float, most: float) -> Estimate:
        """Return the estimate with its interval cut at the bounds of the figure, which Student's interval ignores."""
        low, high = np.clip((self.low, self.high), least, most)
        return Estimate(self.value, float(low), float(high))


# Nothing was measured.
UNKNOWN = Estimate(math.nan, math.nan, math.nan)


def mean(samples: FloatArray) -> FloatArray:
    """Return the mean over the last axis, ignoring NaN; NaN if all values are NaN."""
    is_known = ~np.isnan(samples)
    if is_known.all():
        return np.asarray(samples.mean(axis=-1))
    counts = is_known.sum(axis=-1)
    return np.where(counts > 0, np.nansum(samples, axis=-1) / np.maximum(counts, 1), np.nan)


def quantile(share: float) -> Statistic:
    """Return a statistic like `mean` that computes a quantile over the last axis, by interpolation."""

    def statistic(samples: FloatArray) -> FloatArray:
        # NaNs come last.
        ordered = np.sort(samples, axis=-1)
        last = (~np.isnan(samples)).sum(axis=-1, keepdims=True) - 1
        place = np.maximum(last, 0) * share
        below = np.floor(place).astype(np.intp)
        above = np.minimum(below + 1, np.maximum(last, 0))
        low, high = np.take_along_axis(ordered, below, axis=-1), np.take_along_axis(ordered, above, axis=-1)
        return np.asarray((low + (high - low) * (place - below))[..., 0])

    return statistic


def interquartile_mean(samples: FloatArray) -> FloatArray:
    """Return the mean over the last axis without the lowest and the highest quarter, ignoring NaN as `mean` does.

    Of n values, n // 4 are left out at each end, as `scipy.stats.trim_mean` does.
    """
    # NaNs come last.
    ordered = np.sort(samples, axis=-1)
    n_known = (~np.isnan(samples)).sum(axis=-1, keepdims=True)
    n_cut = n_known // 4
    places = np.arange(samples.shape[-1])
    return mean(np.where((places >= n_cut) & (places < n_known - n_cut), ordered, np.nan))


def estimates(
    columns: Mapping[str, tuple[Statistic, Sequence[float]]],
    subjects: Sequence[Hashable],
    *,
    trainings: Sequence[Hashable] | None = None,
) -> dict[str, Estimate]:
    """Return figures with their intervals, by name; all from the same resamples, which are the same every time.

    Args:
        columns: Statistic and values of each figure, by its name; one value for each episode, NaN to leave it out. A
            figure measured in one episode alone, or on one of several subjects, has no interval.
        subjects: Subject of each episode's volume.
        trainings: Training of each episode. Default: None, all are from one.

    Raises:
        InvalidValueError: If a column has another length than `subjects`, or there is no episode.
    """
    trainings = [None] * len(subjects) if trainings is None else trainings
    lengths = {len(trainings), *(len(values) for _, values in columns.values())}
    if not subjects or lengths != {len(subjects)}:
        raise InvalidValueError("every figure must have one value for each episode, and there must be an episode")
    arrays = {name: np.asarray(values, dtype=float) for name, (_, values) in columns.items()}
    resampled: dict[str, list[FloatArray]] = {name: [] for name in columns}
    for places in _resamples(trainings, subjects):
        for name, (statistic, _) in columns.items():
            # Index -1, an unused place, reads the NaN that is appended here.
            resampled[name].append(statistic(np.append(arrays[name], np.nan)[places]))
    found = {}
    for name, (statistic, _) in columns.items():
        value, is_known = float(statistic(arrays[name])), np.isfinite(arrays[name])
        measured = {subject for subject, known in zip(subjects, is_known, strict=True) if known}
        # One episode, or one subject of several, says nothing about others.
        is_single = is_known.sum() < 2 or len(measured) < min(2, len(set(subjects)))
        of_name = np.empty(0) if is_single else np.concatenate(resampled[name])
        found[name] = _estimate(value, of_name)
    return found


def _estimate(value: float, resampled: FloatArray) -> Estimate:
    known = resampled[~np.isnan(resampled)]
    if not len(known):
        return Estimate(value, math.nan, math.nan)
    low, high = np.quantile(known, [LOWER, UPPER])
    return Estimate(value, float(low), float(high))


def _resamples(trainings: Sequence[Hashable], subjects: Sequence[Hashable]) -> Iterator[NDArray[np.intp]]:
    """Yield the indices of the episodes of all resamples, shape (n_resamples, n_places), -1 for unused places."""
    rng = np.random.default_rng(0)
    of_training, of_subject = _numbered(trainings), _numbered(subjects)
    shape = int(of_training.max()) + 1, int(of_subject.max()) + 1
    sizes = np.zeros(shape, dtype=np.intp)
    np.add.at(sizes, (of_training, of_subject), 1)
    members = np.full((*shape, sizes.max()), -1)
    filled = np.zeros(shape, dtype=np.intp)
    for place, cell in enumerate(zip(of_training, of_subject, strict=True)):
        members[(*cell, filled[cell])] = place
        filled[cell] += 1
    at_once = max(1, MAX_VALUES // members.size)
    for first in range(0, N_RESAMPLES, at_once):
        n_resamples = min(at_once, N_RESAMPLES - first)
        drawn_trainings = rng.integers(shape[0], size=(n_resamples, shape[0], 1, 1))
        drawn = drawn_trainings, rng.integers(shape[1], size=(n_resamples, 1, shape[1], 1))
        within = (rng.random((n_resamples, *members.shape)) * sizes[drawn]).astype(np.intp)
        # Subjects with fewer episodes leave the rest of their row unused.
        chosen = np.where(np.arange(members.shape[-1]) < sizes[drawn], members[(*drawn, within)], -1)
        yield chosen.reshape(n_resamples, -1)


def _numbered(labels: Sequence[Hashable]) -> NDArray[np.intp]:
    """Return the number of each label, in order of first appearance."""
    numbers: dict[Hashable, int] = {}
    return np.array([numbers.setdefault(label, len(numbers)) for label in labels], dtype=np.intp)

"""Paired difference of two groups of trainings with the same seeds, evaluated on the same volumes.

The difference for each seed and volume is modelled as a seed effect, a volume effect and a residual: a two-way layout
with random effects, with Satterthwaite's degrees of freedom (1946, doi:10.2307/3002019), as diagnostic studies cross
readers and cases (Hillis 2014, doi:10.1002/sim.5926). With two or three seeds their mean square is often small by
chance; the degrees of freedom are then those of the volumes, which is too many. So the interval is made at least as
wide as Student's for other seeds alone, and for other subjects alone. Unlike a percentile bootstrap, it is then wide
enough for few seeds and volumes. Several volumes of one subject are alike, and count as one: see `of_subjects`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from armscan.errors import InvalidValueError
from armscan.stats.bootstrap import UPPER, Estimate
from armscan.utils.arrays import FloatArray


def paired_difference(ours: FloatArray, theirs: FloatArray, subjects: Sequence[str] | None = None) -> Estimate:
    """Return the mean difference, ours minus theirs, with its 95 % interval for other seeds and other subjects.

    Args:
        ours: Our scores, shape (seeds, volumes), all finite.
        theirs: Their scores for the same seeds and volumes.
        subjects: Subject of each volume. Default: None, each volume is its own subject.

    Returns:
        The estimate; without an interval if there is one seed, which says nothing about others.

    Raises:
        InvalidValueError: If the shapes differ.
    """
    if ours.shape != theirs.shape:
        raise InvalidValueError(f"scores have the shapes {ours.shape} and {theirs.shape}, but both must have the same")
    differences = ours - theirs
    return mean_over_seeds(differences if subjects is None else of_subjects(differences, subjects))


def mean_over_seeds(scores: FloatArray) -> Estimate:
    """Return the mean score with its 95 % interval for other seeds and other subjects.

    Args:
        scores: Scores, shape (seeds, volumes).

    Returns:
        The estimate; without an interval if there is one seed, or a score is NaN.
    """
    mean, half = crossed_mean(scores)
    half = half if len(scores) > 1 else np.nan
    return Estimate.around(mean, half)


def of_subjects(values: FloatArray, subjects: Sequence[str]) -> FloatArray:
    """Return values of subjects instead of volumes, with the same mean.

    A subject's value is the overall mean plus the deviation of its volumes' mean from it, weighted by its number of
    volumes relative to the average subject's: the linearised ratio estimator (Cochran 1977, Sampling Techniques,
    section 6.3).

    Args:
        values: Values, shape (..., seeds, volumes).
        subjects: Subject of each volume.

    Returns:
        Values, shape (..., seeds, subjects).
    """
    names, number_of = np.unique(subjects, return_inverse=True)
    n_subjects, n_volumes = len(names), len(subjects)
    # Unchanged to the last bit: the product below would round.
    if n_subjects == n_volumes:
        return values
    centre = values.mean(axis=(-2, -1), keepdims=True)
    return np.asarray(centre + (values - centre) @ np.eye(n_subjects)[number_of] * n_subjects / n_volumes)


def weighted_by_volume(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return values whose plain mean is the weighted mean of these, linearised as `of_subjects` does.

    Args:
        values: Values, shape (..., seeds, volumes).
        weights: Weight of each volume, 1 on average, shape (volumes,).
    """
    # Unchanged to the last bit: the product below would round.
    if (weights == 1.0).all():
        return values
    centre = (values * weights).mean(axis=(-2, -1), keepdims=True)
    return np.asarray(centre + (values - centre) * weights)


def crossed_mean(values: FloatArray) -> tuple[Any, Any]:
    """Return means over seeds and volumes, and half the widths of their 95 % intervals.

    Args:
        values: Values, shape (..., seeds, volumes).

    Returns:
        Two arrays of shape (...); the second is NaN if there is one seed and one volume.
    """
    from scipy.special import stdtrit

    n_seeds, n_volumes = values.shape[-2:]
    means = values.mean(axis=(-2, -1))
    of_seeds, of_volumes = values.mean(axis=-1), values.mean(axis=-2)
    centre = means[..., None]
    # Mean squares of the seeds, the volumes and the residual; 0 if there is only one seed or volume.
    seeds = n_volumes * ((of_seeds - centre) ** 2).sum(axis=-1) / max(1, n_seeds - 1)
    volumes = n_seeds * ((of_volumes - centre) ** 2).sum(axis=-1) / max(1, n_volumes - 1)
    rest = values - of_seeds[..., :, None] - of_volumes[..., None, :] + centre[..., None]
    rest = (rest**2).sum(axis=(-2, -1)) / max(1, (n_seeds - 1) * (n_volumes - 1))
    if n_seeds == n_volumes == 1:
        return means, np.full_like(means, np.nan)
    # Each mean square contains the residual's once; if the volumes' is no larger, they do not differ.
    differ = volumes > rest if n_seeds > 1 else np.full(means.shape, True)
    variances = np.maximum(seeds + np.where(differ, volumes - rest, 0.0), volumes)
    # Seeds and volumes can have equal means although their values differ.
    variances = np.where(variances > 0.0, variances, rest)
    terms = seeds**2 / max(1, n_seeds - 1) + np.where(differ, volumes**2 / max(1, n_volumes - 1), 0.0)
    # Without any of these spreads, their degrees of freedom limit nothing.
    df = np.where(terms > 0.0, variances**2 / np.where(terms > 0.0, terms, 1.0), np.inf)
    halves = stdtrit(df, UPPER) * np.sqrt(variances)
    for mean_square, n in ((seeds, n_seeds), (volumes, n_volumes)):
        if n > 1:
            halves = np.maximum(halves, stdtrit(n - 1, UPPER) * np.sqrt(mean_square))
    return means, halves / np.sqrt(n_seeds * n_volumes)

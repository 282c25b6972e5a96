"""Seed rules: how many trainings each configuration gets before one is chosen, for many choices at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, stdtrit
from scipy.stats import rankdata

from armscan.sweeps.scheduling.race import (
    PRIOR_DF,
    Counts,
    allocate,
    half_widths,
    is_decided,
    moderated_variances,
    moments,
    round_size,
)
from armscan.utils.arrays import FloatArray

# Seeds that are simulated for each configuration: no rule takes more.
MAX_SEEDS = 48
# Confidence of Friedman's test, as in irace.
FRIEDMAN_LEVEL = 0.95
# Confidence of the t tests that ended armscan's race formerly, and the seeds that its leader had to have.
T_LEVEL, T_LEADER_SEEDS = 0.95, 4
Mask = NDArray[np.bool_]


class Chosen(NamedTuple):
    """Outcome of a rule.

    Args:
        place: Place of each choice's configuration, shape (choices,).
        n_trainings: Trainings of each choice, shape (choices,).
    """

    place: NDArray[np.intp]
    n_trainings: NDArray[np.intp]


# Scores of shape (choices, configurations, seeds), greater is better.
SeedRule = Callable[[FloatArray], Chosen]
# Maps the scores of the seeds so far, and the configurations that are in, to the configurations that stay in.
Drop = Callable[[FloatArray, Mask], Mask]
# Maps means, variances and seeds of configurations to whether the race is over.
Ends = Callable[[FloatArray, FloatArray, Counts], Mask]


def fixed(n_seeds: int) -> SeedRule:
    """Return the rule that gives the same number of seeds to all, and chooses the best mean."""

    def choose(scores: FloatArray) -> Chosen:
        n_choices, n_configs, _ = scores.shape
        means = scores[..., :n_seeds].mean(axis=-1)
        return Chosen(means.argmax(axis=1), np.full(n_choices, n_seeds * n_configs))

    return choose


def t_race(min_seeds: int, max_seeds: int, level: float) -> SeedRule:
    """Return the rule that, after each seed, drops those behind the leader by a one-sided t test.

    Args:
        min_seeds: Seeds of all configurations.
        max_seeds: Seeds of those that are never dropped.
        level: Confidence at which a configuration is dropped, from 0.5 to below 1.
    """
    return partial(_raced, rounds=range(min_seeds, max_seeds + 1), drop=partial(_behind_by_t, level=level))


def friedman_race(min_seeds: int, max_seeds: int) -> SeedRule:
    """Return the race of irace (López-Ibáñez et al. 2016): Friedman's test, then Conover's (1999) against the best."""
    return partial(_raced, rounds=range(min_seeds, max_seeds + 1), drop=_behind_by_ranks)


def halving(min_seeds: int) -> SeedRule:
    """Return successive halving over seeds (Karnin et al. 2013): the better half gets twice as many, until one is left.

    Args:
        min_seeds: Seeds of all configurations.
    """
    rounds = [n for power in range(MAX_SEEDS) if (n := min_seeds * 2**power) < MAX_SEEDS]
    return partial(_raced, rounds=[*rounds, MAX_SEEDS], drop=_worse_half)


def is_ahead(means: FloatArray, variances: FloatArray, n_seeds: Counts) -> Mask:
    """Return whether the leader passes one-sided t tests against all others; see `is_decided` for the arguments."""
    leader = means.argmax(axis=-1)[..., np.newaxis]
    mean, of_mean, n_leader = (np.take_along_axis(each, leader, -1) for each in (means, variances / n_seeds, n_seeds))
    df = PRIOR_DF + np.minimum(n_seeds, n_leader) - 1
    is_behind = mean - means > stdtrit(df, T_LEVEL) * np.sqrt(of_mean + variances / n_seeds)
    return np.asarray((n_leader[..., 0] >= T_LEADER_SEEDS) & (is_behind.sum(axis=-1) == means.shape[-1] - 1))


def allocation(
    min_seeds: int, mean_seeds: int, *, n_at_once: int | None = None, ends: Ends | None = is_decided
) -> SeedRule:
    """Return the race of armscan, see `armscan.sweeps.scheduling.race.race`, with at most the seeds that are simulated.

    Args:
        min_seeds: Seeds of all configurations, 2 or more.
        mean_seeds: Seeds of a configuration on average, at most.
        n_at_once: Trainings of a round after the first. Default: None, as many as in armscan.
        ends: Function that decides whether the race ends before its budget is used. None: it never does. Default:
            `is_decided`, as in armscan.
    """

    def choose(scores: FloatArray) -> Chosen:
        n_choices, n_configs, n_most = scores.shape
        n_seeds, is_over = np.full((n_choices, n_configs), min_seeds), np.zeros(n_choices, bool)
        left = (mean_seeds - min_seeds) * n_configs
        while left > 0 and not is_over.all():
            means, variances = moments(scores, n_seeds)
            if ends is not None:
                is_over |= ends(means, variances, n_seeds)
            n_more = min(n_at_once or round_size(n_configs), left)
            more = allocate(means, variances, n_seeds, n_more, most=n_most)
            n_seeds, left = np.where(is_over[:, np.newaxis], n_seeds, more), left - n_more
        means, variances = moments(scores, n_seeds)
        lower = means - half_widths(variances, n_seeds)
        return Chosen(lower.argmax(axis=1), n_seeds.sum(axis=1))

    return choose


def _raced(scores: FloatArray, *, rounds: Sequence[int], drop: Drop) -> Chosen:
    """Run rounds with these seeds until one configuration is left; choose the highest lower end of an interval."""
    is_in, n_seeds = np.ones(scores.shape[:2], bool), np.zeros(scores.shape[:2], np.intp)
    lower = np.zeros(scores.shape[:2])
    for n_now in rounds:
        runs = is_in & (is_in.sum(axis=1, keepdims=True) > 1)
        if not runs.any():
            break
        n_seeds[runs] = n_now
        seen = scores[..., :n_now]
        means, variances = _standing(seen, is_in)
        lower = np.where(runs, means - half_widths(variances, n_now), lower)
        is_in = np.where(runs.any(axis=1, keepdims=True), drop(seen, is_in), is_in)
    return Chosen(np.where(is_in, lower, -np.inf).argmax(axis=1), n_seeds.sum(axis=1))


def _standing(seen: FloatArray, is_in: Mask) -> tuple[FloatArray, FloatArray]:
    """Return the means of configurations with equally many seeds, and their shrunk variances."""
    n_seeds = seen.shape[-1]
    means = seen.mean(axis=-1)
    if n_seeds == 1:
        return means, np.zeros_like(means)
    own = seen.var(axis=-1, ddof=1)
    pooled = np.where(is_in, own, 0.0).sum(axis=1, keepdims=True) / is_in.sum(axis=1, keepdims=True)
    return means, moderated_variances(own, pooled, n_seeds)


def _behind_by_t(seen: FloatArray, is_in: Mask, *, level: float) -> Mask:
    n_seeds = seen.shape[-1]
    means, variances = _standing(seen, is_in)
    leader = np.where(is_in, means, -np.inf).argmax(axis=1)[:, np.newaxis]
    behind = np.take_along_axis(means, leader, axis=1) - means
    spread = np.sqrt((variances + np.take_along_axis(variances, leader, axis=1)) / n_seeds)
    return is_in & ((behind <= stdtrit(PRIOR_DF + n_seeds - 1, level) * spread) | (n_seeds == 1))


def _behind_by_ranks(seen: FloatArray, is_in: Mask) -> Mask:
    n_seeds, n_left = seen.shape[-1], is_in.sum(axis=1, keepdims=True)
    # The best has rank 1; dropped ones come last, so that they change no other rank.
    ranks = np.where(is_in[..., np.newaxis], rankdata(np.where(is_in[..., np.newaxis], -seen, np.inf), axis=1), 0.0)
    sums, squares = ranks.sum(axis=-1), (ranks**2).sum(axis=(1, 2))[:, np.newaxis]
    with np.errstate(divide="ignore", invalid="ignore"):
        of_sums = np.where(is_in, (sums - n_seeds * (n_left + 1) / 2) ** 2, 0.0).sum(axis=1, keepdims=True)
        statistic = (n_left - 1) * of_sums / (squares - n_seeds * n_left * (n_left + 1) ** 2 / 4)
        df = (n_seeds - 1) * (n_left - 1)
        rest = np.maximum(n_seeds * squares - (sums**2).sum(axis=1, keepdims=True), 0.0)
        allowed = stdtrit(df, (1 + FRIEDMAN_LEVEL) / 2) * np.sqrt(2 * rest / df)
        differ = statistic > chdtri(n_left - 1, 1 - FRIEDMAN_LEVEL)
    best = np.where(is_in, sums, np.inf).min(axis=1, keepdims=True)
    return is_in & (~differ | (sums - best <= allowed))


def _worse_half(seen: FloatArray, is_in: Mask) -> Mask:
    means = np.where(is_in, seen.mean(axis=-1), -np.inf)
    n_kept = np.ceil(is_in.sum(axis=1, keepdims=True) / 2)
    return is_in & (rankdata(-means, method="ordinal", axis=1) <= n_kept)

"""Seed rules for many choices at once: armscan's is its race, the others do what they are named after."""

import numpy as np
import pytest

from benchmarks.sweeps.bench.replay import choose
from benchmarks.sweeps.bench.seed_rules import MAX_SEEDS, allocation, fixed, friedman_race, halving, t_race


def scores_of(means, n_choices=50, spread=1.0):
    """Return scores of configurations with these means, shape (choices, configurations, seeds)."""
    noise = np.random.default_rng(0).standard_normal((n_choices, len(means), MAX_SEEDS))
    return np.array(means)[:, np.newaxis] + spread * noise


@pytest.mark.parametrize(("min_seeds", "mean_seeds"), [(2, 6), (5, 5), (3, 8)])
def test_allocation_is_the_race_of_armscan(min_seeds, mean_seeds):
    scores = scores_of([0.0, 0.3, 0.6, -2.0, 0.5])
    found = allocation(min_seeds, mean_seeds)(scores)
    assert list(zip(found.place, found.n_trainings, strict=True)) == [
        (each.place, each.n_trainings)
        for each in (choose(one, min_seeds=min_seeds, mean_seeds=mean_seeds) for one in scores)
    ]


def test_t_test_drops_what_is_far_behind():
    apart, alike = (t_race(3, 8, 0.9)(scores_of(means)) for means in ([0.0, 9.0, 0.0], [0.0, 0.0, 0.0]))
    assert set(apart.place) == {1}
    assert set(apart.n_trainings) == {9}
    assert np.median(alike.n_trainings) > 12


def test_same_number_of_seeds_drops_nobody():
    found = fixed(4)(scores_of([0.0, 9.0, 0.0]))
    assert set(found.n_trainings) == {12}
    assert set(found.place) == {1}


def test_halving_gives_the_better_half_twice_as_many_seeds():
    found = halving(3)(scores_of([0.0, 20.0, 10.0, 0.0, 0.0]))
    # Of five configurations three go on, then two, then one.
    assert set(found.n_trainings) == {5 * 3 + 3 * 3 + 2 * 6}
    assert set(found.place) == {1}


def test_friedmans_test_drops_what_is_always_behind_and_nothing_without_a_difference():
    apart, alike = (friedman_race(5, 12)(scores_of(means)) for means in ([0.0, 9.0, 0.0], [0.0, 0.0, 0.0]))
    assert set(apart.place) == {1}
    assert apart.n_trainings.max() < 3 * 12
    assert np.median(alike.n_trainings) == 3 * 12


def test_ranks_of_equal_scores_drop_nobody():
    assert set(friedman_race(3, 5)(np.zeros((2, 3, MAX_SEEDS))).n_trainings) == {15}


def test_budget_is_allocated_to_those_close_to_the_best():
    scores = scores_of([0.0, 0.2, -9.0])
    found = allocation(2, 6, ends=None)(scores)
    assert set(found.n_trainings) == {18}
    close = (found.place < 2).mean()
    assert close == 1.0
    # It tells the two apart about as well as the same seeds for all do, or better.
    assert (found.place == 1).mean() > (fixed(6)(scores).place == 1).mean() - 0.1

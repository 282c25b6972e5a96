"""Race over seeds: trainings and choice do not depend on the order in which trainings finish."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import t

from armscan.sweeps.scheduling.race import (
    END_LOSS,
    LEADER_SEEDS,
    MAX_SEEDS_FACTOR,
    PRIOR_DF,
    allocate,
    budget,
    half_widths,
    is_decided,
    moments,
    race,
    round_size,
)

SEEDS = tuple(range(1000, 1012))
score = st.one_of(st.floats(-9, 9), st.sampled_from([0.0, 1.0, math.nan]))
scores_of_seeds = st.lists(score, min_size=len(SEEDS), max_size=len(SEEDS))
tables = st.dictionaries(st.integers(-1, 50), scores_of_seeds, min_size=1, max_size=6)
seed_counts = st.tuples(st.integers(1, 4), st.integers(1, 4)).map(sorted)


def run(table, counts, order, seeds=SEEDS):
    """Run a race to its end; return it, and the trainings in the order in which they finished."""
    scores, done = {each: {} for each in table}, []
    min_seeds, mean_seeds = counts
    while missing := race(scores, seeds, min_seeds=min_seeds, mean_seeds=mean_seeds).missing:
        configuration, seed = order(missing)
        scores[configuration][seed] = table[configuration][seeds.index(seed)]
        done.append((configuration, seed))
    return race(scores, seeds, min_seeds=min_seeds, mean_seeds=mean_seeds), done


@given(tables, seed_counts, st.randoms(use_true_random=False))
def test_race_ends_within_its_budget_with_one_choice_in_any_order_of_trainings(table, counts, random):
    first, trained = run(table, counts, lambda missing: missing[0])
    other, trained_otherwise = run(table, counts, random.choice)
    fewest, most = budget(len(table), min_seeds=counts[0], mean_seeds=counts[1])
    assert first.chosen == other.chosen
    assert len(trained_otherwise) == len(set(trained_otherwise)) <= most
    has_failed = any(math.isnan(table[number][SEEDS.index(seed)]) for number, seed in trained)
    assert len(trained) >= len(table) * counts[0]
    assert has_failed or len(trained) >= fewest
    assert set(trained) == set(trained_otherwise)
    assert repr(first) == repr(other)
    if any(not np.isnan(row).any() for row in table.values()):
        assert not math.isnan(first.standings[first.chosen].estimate.value)


@given(tables, seed_counts)
def test_scores_of_seeds_to_come_change_nothing(table, counts):
    """A race may have been run further before, with other candidates."""
    whole = {each: dict(zip(SEEDS, row, strict=True)) for each, row in table.items()}
    ahead, _ = run(table, counts, lambda missing: missing[0])
    assert race(whole, SEEDS, min_seeds=counts[0], mean_seeds=counts[1]).chosen == ahead.chosen


def test_race_begins_with_few_seeds_of_all_and_continues_with_those_that_may_be_the_best():
    scores = {-1: {}, 4: {}, 7: {}, 9: {}}
    begun = race(scores, SEEDS, min_seeds=2, mean_seeds=6)
    assert begun.missing == tuple((each, seed) for seed in (1000, 1001) for each in (-1, 4, 7, 9))
    assert (begun.leader, begun.n_trained) == (None, 0)
    close = {-1: {1000: 0.9, 1001: 1.1}, 4: {1000: 1.2, 1001: 0.9}}
    scores = close | {7: {1000: -8.0, 1001: -7.7}, 9: {1000: -9.0, 1001: -8.7}}
    later = race(scores, SEEDS, min_seeds=2, mean_seeds=6)
    # A round has two trainings, or a third as many as there are configurations.
    assert later.missing == ((-1, 1002), (4, 1002))
    assert (later.leader, later.n_trained) == (4, 8)
    assert later.chosen is None


def test_race_ends_early_once_the_leader_has_enough_seeds_and_is_far_ahead():
    table = {-1: [9.0, 9.2] * 6, 4: [1.0, 1.2] * 6, 7: [1.1, 0.9] * 6}
    ended, trained = run(table, (2, 6), lambda missing: missing[0])
    assert ended.chosen == -1
    assert [number for number, _ in trained].count(-1) == LEADER_SEEDS
    assert len(trained) < 18


def test_same_seeds_for_all_take_one_round():
    table = {-1: [9.0, 9.2] * 6, 4: [1.0, 1.2] * 6}
    assert sorted(run(table, (3, 3), lambda missing: missing[0])[1]) == [
        (number, seed) for number in (-1, 4) for seed in SEEDS[:3]
    ]


def test_configuration_whose_training_failed_is_out_at_the_end_of_the_round():
    scores = {-1: {1000: 1.0}, 4: {1000: math.nan}, 7: {1000: 1.0}}
    assert race(scores, SEEDS, min_seeds=2, mean_seeds=4).missing == ((-1, 1001), (4, 1001), (7, 1001))
    for of_seed in scores.values():
        of_seed[1001] = 1.1
    later = race(scores, SEEDS, min_seeds=2, mean_seeds=4)
    assert {number for number, _ in later.missing} <= {-1, 7}
    assert later.standings[4].has_failed


def test_where_all_fail_the_round_before_decides_and_nothing_in_the_first():
    failed = {each: {1000: math.nan, 1001: 1.0} for each in (-1, 4)}
    ended = race(failed, SEEDS, min_seeds=2, mean_seeds=4)
    assert (ended.is_over, ended.chosen) == (True, None)
    # Both fail in the second round.
    table = {-1: [1.0, 1.1, *[math.nan] * 10], 4: [1.1, 1.2, *[math.nan] * 10]}
    assert run(table, (2, 4), lambda missing: missing[0])[0].chosen == 4


def test_race_ends_once_the_remaining_configurations_have_all_seeds():
    table = {-1: [1.0, 1.2, 1.1], 4: [1.1, 1.0, 1.3], 7: [math.nan] * 3, 9: [math.nan] * 3}
    ended, trained = run(table, (1, 3), lambda missing: missing[0], seeds=SEEDS[:3])
    assert ended.n_trained == len(trained) == 8
    assert [(each.n_seeds, each.estimate.value) for each in map(ended.standings.get, (-1, 4))] == [
        (3, pytest.approx(np.mean(table[each]))) for each in (-1, 4)
    ]


def test_first_of_equal_configurations_is_chosen():
    table = {-1: [1.0] * 12, 4: [1.0] * 12}
    assert run(table, (2, 4), lambda missing: missing[-1])[0].chosen == -1


def test_unsteady_configuration_loses_against_a_steady_one_that_is_hardly_worse():
    table = {3: [0.5, 1.6, 0.4, 1.7] * 3, 5: [1.0, 1.01, 0.99, 1.0] * 3}
    assert run(table, (2, 4), lambda missing: missing[0])[0].chosen == 5


def test_seeds_are_allocated_as_in_the_optimal_computing_budget_allocation():
    """Shares in proportion to variance over squared gap; the leader's balances them (Chen et al. 2000)."""
    means, variances = np.array([5.0, 4.0, 3.0]), np.array([1.0, 1.0, 4.0])
    # 1 / 1 and 4 / 4, so equal shares, and the square root of 1 + 1 / 4 times that for the leader.
    found = allocate(means, variances, np.array([2, 2, 2]), 3000, most=10_000)
    leader = (1.0 + 1.0 / 4.0) ** 0.5
    assert found / found.sum() == pytest.approx(np.array([leader, 1.0, 1.0]) / (leader + 2.0), abs=1e-3)
    # The unit of the scores does not matter, nor do equal scores.
    tiny = allocate(1e-12 * means, 1e-24 * variances, np.array([2, 2, 2]), 3000, most=10_000)
    assert tiny.tolist() == found.tolist()
    assert allocate(np.zeros(3), np.zeros(3), np.array([2, 2, 2]), 3, most=10).sum() == 9
    capped = allocate(means, variances, np.array([2, 2, 2]), 6, most=4)
    assert capped.tolist() == [4, 4, 4]


def test_variances_are_shrunk_towards_their_mean_as_in_moderated_t_statistics():
    """Each counts by its degrees of freedom, the mean by `PRIOR_DF` (Smyth 2004)."""
    scores, n_seeds = np.random.default_rng(0).standard_normal((4, 5)), np.array([2, 5, 3, 1])
    means, variances = moments(scores, n_seeds)
    played = [row[:n] for row, n in zip(scores, n_seeds, strict=True)]
    own = np.array([each.var(ddof=1) for each in played[:-1]])
    # A single seed has no variance of its own, so it takes the mean.
    df = n_seeds[:-1] - 1
    expected = [*(PRIOR_DF * own.mean() + df * own) / (PRIOR_DF + df), own.mean()]
    assert means == pytest.approx([each.mean() for each in played])
    assert variances == pytest.approx(expected)
    widths = [t.ppf(0.975, PRIOR_DF + n - 1) * (of_it / n) ** 0.5 for n, of_it in zip(n_seeds, expected, strict=True)]
    assert half_widths(variances, n_seeds) == pytest.approx(widths)


def test_race_is_decided_where_the_expected_loss_from_choosing_the_leader_is_small():
    n_seeds, variances = np.array([LEADER_SEEDS + 2, LEADER_SEEDS, 3]), np.array([1.0, 2.0, 0.5])
    rng = np.random.default_rng(0)
    for gaps in ((1.0, 0.8), (2.0, 1.5), (2.5, 0.5), (0.5, 2.5), (1.2, 1.2)):
        means = np.array([0.0, *(-gap for gap in gaps)])
        true = means + (variances / n_seeds) ** 0.5 * rng.standard_normal((1_000_000, 3))
        losses = np.maximum(0.0, true[:, 1:] - true[:, :1]).mean(axis=0) / variances.mean() ** 0.5
        assert bool(is_decided(means, variances, n_seeds)) is bool((losses <= END_LOSS).all()), gaps
        # Neither the unit of the scores nor their zero matters.
        assert is_decided(3e9 + 1e-3 * means, 1e-6 * variances, n_seeds) == is_decided(means, variances, n_seeds)
    # However far ahead, a leader with few seeds decides nothing.
    assert not is_decided(np.array([9e9, 0.0, 0.0]), variances, np.array([LEADER_SEEDS - 1, 9, 9]))


def test_race_is_decided_once_equal_configurations_have_many_seeds_or_no_noise():
    means, variances = np.zeros(3), np.ones(3)
    # The expected loss between equals is the spread of their difference over the square root of 2 pi.
    n_enough = math.ceil(2 / (2 * math.pi * END_LOSS**2))
    assert not is_decided(means, variances, np.full(3, n_enough - 1))
    assert is_decided(means, variances, np.full(3, n_enough))
    assert is_decided(means, np.zeros(3), np.full(3, LEADER_SEEDS))


@pytest.mark.parametrize(("n_configurations", "expected"), [(2, 2), (4, 2), (8, 2), (9, 3), (13, 4)])
def test_round_has_a_training_for_every_three_configurations_but_at_least_two(n_configurations, expected):
    assert round_size(n_configurations) == expected


@pytest.mark.parametrize("n_configurations", [4, 8])
def test_race_needs_fewer_trainings_than_the_same_seeds_for_all_at_no_more_regret(n_configurations):
    rng = np.random.default_rng(0)
    n_trained, regret, regret_of_all = 0, 0.0, 0.0
    n_studies, n_fixed = 200, 9
    seeds = tuple(range(MAX_SEEDS_FACTOR * 12))
    for _ in range(n_studies):
        true = 0.7 * rng.standard_normal(n_configurations)
        table = true[:, None] + 0.6 * rng.standard_normal((n_configurations, len(seeds)))
        raced, done = run(dict(enumerate(table)), (2, 12), lambda missing: missing[0], seeds=seeds)
        n_trained += len(done)
        regret += true.max() - true[raced.chosen]
        regret_of_all += true.max() - true[table[:, :n_fixed].mean(axis=1).argmax()]
    assert n_trained / n_studies < 0.58 * n_fixed * n_configurations
    assert regret <= 1.05 * regret_of_all

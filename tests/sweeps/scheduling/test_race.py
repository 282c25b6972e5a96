"""Race over seeds: trainings and choice do not depend on the order in which trainings finish."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armscan.sweeps.scheduling.race import budget, race

SEEDS = tuple(range(1000, 1006))
score = st.one_of(st.floats(-9, 9), st.sampled_from([0.0, 1.0, math.nan]))
tables = st.dictionaries(st.integers(-1, 50), st.lists(score, min_size=6, max_size=6), min_size=1, max_size=6)


def run(table, min_seeds, order, seeds=SEEDS):
    """Run a race to its end; return it, and the trainings in the order in which they finished."""
    scores, done = {each: {} for each in table}, []
    while missing := race(scores, seeds, min_seeds=min_seeds).missing:
        configuration, seed = order(missing)
        scores[configuration][seed] = table[configuration][seeds.index(seed)]
        done.append((configuration, seed))
    return race(scores, seeds, min_seeds=min_seeds), done


@given(tables, st.integers(1, 6), st.randoms(use_true_random=False))
def test_race_ends_within_its_budget_with_one_choice_in_any_order_of_trainings(table, min_seeds, random):
    first, trained = run(table, min_seeds, lambda missing: missing[0])
    other, trained_otherwise = run(table, min_seeds, random.choice)
    fewest, most = budget(len(table), min_seeds=min_seeds, max_seeds=len(SEEDS))
    assert first.chosen == other.chosen
    assert len(trained_otherwise) == len(set(trained_otherwise)) <= most
    assert len(trained) >= fewest
    assert set(trained) == set(trained_otherwise)
    assert repr(first) == repr(other)
    if any(not np.isnan(row).any() for row in table.values()):
        assert not math.isnan(first.standings[first.chosen].estimate.value)


@given(tables, st.integers(2, 6))
def test_scores_of_seeds_to_come_change_nothing(table, min_seeds):
    """A race may have been run further before, with other candidates."""
    whole = {each: dict(zip(SEEDS, row, strict=True)) for each, row in table.items()}
    ahead, _ = run(table, min_seeds, lambda missing: missing[0])
    assert race(whole, SEEDS, min_seeds=min_seeds).chosen == ahead.chosen


def test_race_begins_with_few_seeds_of_all_and_goes_on_with_one_seed_of_those_that_are_left():
    scores = {-1: {}, 4: {}, 7: {}}
    begun = race(scores, SEEDS, min_seeds=2)
    assert begun.missing == ((-1, 1000), (4, 1000), (7, 1000), (-1, 1001), (4, 1001), (7, 1001))
    scores = {-1: {1000: 0.9, 1001: 1.1}, 4: {1000: 1.2, 1001: 0.9}, 7: {1000: -8.0, 1001: -7.7}}
    later = race(scores, SEEDS, min_seeds=2)
    assert later.missing == ((-1, 1002), (4, 1002))
    assert not later.standings[7].is_in
    assert later.chosen is None


def test_configuration_whose_training_failed_is_out_at_the_end_of_the_round():
    scores = {-1: {1000: 1.0}, 4: {1000: math.nan}, 7: {1000: 1.0}}
    assert race(scores, SEEDS, min_seeds=2).missing == ((-1, 1001), (4, 1001), (7, 1001))
    for of_seed in scores.values():
        of_seed[1001] = 1.1
    assert race(scores, SEEDS, min_seeds=2).missing == ((-1, 1002), (7, 1002))


def test_where_all_fail_the_round_before_decides_and_nothing_in_the_first():
    failed = {each: {1000: math.nan, 1001: 1.0} for each in (-1, 4)}
    assert (race(failed, SEEDS, min_seeds=2).is_over, race(failed, SEEDS, min_seeds=2).chosen) == (True, None)
    later = {-1: {1000: 1.0, 1001: 1.1, 1002: math.nan}, 4: {1000: 1.1, 1001: 1.2, 1002: math.nan}}
    assert race(later, SEEDS, min_seeds=2).chosen == 4


def test_first_of_equal_configurations_is_chosen():
    table = {-1: [1.0] * 6, 4: [1.0] * 6}
    assert run(table, 2, lambda missing: missing[-1])[0].chosen == -1


def test_unsteady_configuration_loses_against_a_steady_one_that_is_hardly_worse():
    table = {3: [0.5, 1.6, 0.4, 1.7, 0.5, 1.45], 5: [1.0, 1.01, 0.99, 1.0, 1.01, 0.99]}
    assert run(table, 2, lambda missing: missing[0])[0].chosen == 5


@pytest.mark.parametrize("n_configurations", [4, 8])
def test_race_needs_fewer_trainings_than_the_same_seeds_for_all_at_no_more_regret(n_configurations):
    rng = np.random.default_rng(0)
    n_trained, regret, regret_of_all = 0, 0.0, 0.0
    n_studies, n_fixed = 300, 6
    for _ in range(n_studies):
        true = 0.7 * rng.standard_normal(n_configurations)
        table = true[:, None] + 0.6 * rng.standard_normal((n_configurations, 10))
        raced, done = run(dict(enumerate(table)), 3, lambda missing: missing[0], seeds=tuple(range(10)))
        n_trained += len(done)
        regret += true.max() - true[raced.chosen]
        regret_of_all += true.max() - true[table[:, :n_fixed].mean(axis=1).argmax()]
    assert n_trained / n_studies < 0.85 * n_fixed * n_configurations
    assert regret <= 1.05 * regret_of_all

import numpy as np
import pytest

from benchmarks.sweeps.bench.design import places_of, sobol, values_at
from benchmarks.sweeps.bench.importance import keys_of
from benchmarks.sweeps.bench.power import needed_seeds, power_of, residuals_of
from benchmarks.sweeps.bench.races import N_SEEDS, Choices, candidates_of, choices_of, compare, needed_for
from benchmarks.sweeps.bench.ranking import REFERENCE, ranked, studies_of
from benchmarks.sweeps.bench.replay import Rule, choose, search
from benchmarks.sweeps.bench.seed_rules import fixed
from benchmarks.sweeps.bench.surrogate import SELECTION_PART, Surrogate, fit_of
from tests.benchmarks.conftest import synthetic_curves, true_log


def test_a_surrogate_finds_settings_that_are_truly_good(surrogate):
    space = surrogate.space
    values, _ = surrogate.best()
    everywhere = [true_log(places_of(space, values_at(space, row))) for row in sobol(len(space.parameters), 1000)]
    assert true_log(places_of(space, values)) < np.quantile(everywhere, 0.1)


def test_a_surrogate_knows_configurations_that_it_has_not_seen(curves):
    correlation, explained = fit_of(curves)
    assert correlation > 0.9
    assert explained > 0.8


def test_a_configuration_of_the_table_is_worth_its_own_trainings(curves, surrogate):
    means = curves.mean_over_seeds(np.log(curves.test["mean_steps"]))
    number = int(means.argmin())
    assert surrogate.config(curves.configs[number]).mean[-1] == pytest.approx(means[number])


def test_each_place_has_weights_of_the_table_that_add_up_to_one(surrogate):
    weights = surrogate.weights(np.random.default_rng(0).random((20, 4)))
    assert weights.shape == (20, 60)
    assert weights.sum(axis=1) == pytest.approx(np.ones(20))
    assert (weights >= 0.0).all()


def test_the_truth_is_the_mean_of_simulated_trainings(surrogate):
    config = surrogate.config(surrogate.best()[0])
    rng = np.random.default_rng(0)
    tests = np.array([config.train(rng).test for _ in range(4000)])
    assert tests.mean() == pytest.approx(config.truth, abs=4 * tests.std() / np.sqrt(len(tests)))
    selections = np.array([config.train(rng).selection for _ in range(4000)])
    assert selections.mean() == pytest.approx(config.truth_of(SELECTION_PART), abs=4 * selections.std() / np.sqrt(4000))
    place = np.array([places_of(surrogate.space, surrogate.best()[0])])
    assert surrogate.truth(place) == pytest.approx(config.truth)


def test_chance_is_as_large_as_in_the_table(surrogate):
    rng = np.random.default_rng(0)
    places = sobol(len(surrogate.space.parameters), 30)
    configs = [surrogate.config(values_at(surrogate.space, row)) for row in places]
    logs = np.log([[config.train(rng).test for _ in range(200)] for config in configs])
    # Standard deviation 0.1 between seeds, and 0.025 of a test.
    assert np.sqrt(logs.var(axis=1).mean()) == pytest.approx(0.103, rel=0.1)


@pytest.mark.parametrize("pruner", ["none", "percentile", "median", "halving"])
def test_a_search_ends_when_its_budget_is_spent(surrogate, pruner):
    found = search(surrogate, "sac_y", Rule("random", pruner), n_trainings=20, seed=0)
    assert 20 <= found.n_trainings < 21
    assert (found.n_trials == 20) == (pruner == "none")
    values = [each.value for each in found.candidates]
    assert values == sorted(values)


def test_a_trial_with_two_seeds_takes_two_trainings(surrogate):
    assert search(surrogate, "sac_y", Rule("random", "none", 2), n_trainings=20, seed=0).n_trials == 10


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_a_sampler_that_learns_beats_chance_on_a_smooth_function(curves, surrogate):
    rules, control = (Rule("random", "none"), Rule("tpe", "none")), surrogate.config(curves.configs[0])
    ranks = ranked(studies_of(surrogate, control, "sac_y", rules, n_studies=15, n_trainings=30), by="search")
    assert list(ranks.sampler) == ["tpe", "random"]
    assert (ranks.low <= ranks.regret).all()
    assert (ranks.regret <= ranks.high).all()
    of_reference = ranks[ranks.sampler == REFERENCE.sampler].iloc[0]
    assert of_reference.better == pytest.approx(0.5)


def test_a_choice_with_equal_seeds_has_all_of_them_and_a_race_ends_early():
    scores = np.array([[-9.0], [-1.0], [-8.0]]) + np.random.default_rng(0).normal(0.0, 0.1, (3, 10))
    all_alike = choose(scores, min_seeds=5, mean_seeds=5)
    race = choose(scores, min_seeds=2, mean_seeds=10)
    assert all_alike.place == race.place == 1
    assert all_alike.n_trainings == 15
    assert race.n_trainings < all_alike.n_trainings


def test_trainings_that_a_regret_needs_are_interpolated():
    n_trainings = np.array([3.0, 6.0, 12.0])
    assert needed_for(0.3, np.array([0.4, 0.2, 0.1]), n_trainings) == pytest.approx(4.5)
    # Noise lets a curve rise again.
    assert needed_for(0.2, np.array([0.4, 0.2, 0.3]), n_trainings) == pytest.approx(6.0)
    assert needed_for(0.05, np.array([0.4, 0.2, 0.1]), n_trainings) == np.inf
    assert needed_for(0.5, np.array([0.4, 0.2, 0.1]), n_trainings) == pytest.approx(3.0)


def test_a_race_that_chooses_as_well_with_half_the_trainings_has_a_share_of_half():
    regret = np.random.default_rng(0).random(50)
    of_fixed = [Choices(regret / n, np.full(50, 3.0 * n)) for n in N_SEEDS]
    (race,) = compare(of_fixed, {"a": Choices(regret / 4, np.full(50, 6.0))})
    assert race.share == pytest.approx((0.5, 0.5, 0.5))
    assert race.n_fixed == pytest.approx(12.0)


def test_more_seeds_choose_better(surrogate):
    candidates = candidates_of(surrogate, "sac_y", Rule("random", "none"), n_studies=20, n_trainings=10, top_k=3)
    few, many = choices_of(candidates, {"few": fixed(1), "many": fixed(12)}).values()
    assert many.regret.mean() < few.regret.mean()
    assert many.n_trainings == pytest.approx(np.full(20, 36.0))


@pytest.mark.filterwarnings("ignore:Precision loss")
def test_seeds_that_a_comparison_needs_follow_from_chance():
    good, best = residuals_of(Surrogate.of(synthetic_curves(40))).values()
    assert len(good) > len(best)
    power = power_of(good, n_comparisons=2000)
    assert power.loc[0.0, 20] == pytest.approx(0.05, abs=0.02)
    assert power.loc[0.2, 10] > power.loc[0.1, 10] > power.loc[0.05, 10]
    # For normal noise of 0.103, n = 2 (1.96 + 0.84)^2 (0.103 / log(1.2))^2 = 5 by a z test, and one more by a t test.
    assert needed_seeds(power)[0.2] in (6, 8)


def test_the_key_that_matters_most_is_found(curves):
    keys = keys_of(curves, n_resamples=1)
    assert max(keys, key=lambda name: keys[name].fanova.value) == "agent.lr"
    assert max(keys, key=lambda name: keys[name].effect.value) == "agent.lr"
    assert keys["agent.batch_size"].effect.value < 1.2

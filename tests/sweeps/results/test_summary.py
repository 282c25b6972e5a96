"""What the trainings that judge say of a configuration."""

import numpy as np
import pytest
from optuna.trial import TrialState, create_trial
from rliable.library import get_interval_estimates
from rliable.metrics import aggregate_iqm

from armscan.sweeps.results.summary import final_results
from armscan.sweeps.scheduling.state import FINALIST, METRICS


def judged(number, metrics, state=TrialState.COMPLETE):
    value = 0.0 if state == TrialState.COMPLETE else None
    return create_trial(state=state, value=value, user_attrs={FINALIST: number, METRICS: metrics})


def figures_of(of_volumes):
    metrics = {"mean_steps": 1.0, "test/mean_steps": float(np.mean(of_volumes)), "test/success_rate": 1.0}
    return metrics | {f"test/volume/v{i}/mean_steps": value for i, value in enumerate(of_volumes)}


def test_verdict_is_over_seeds_and_test_volumes():
    scores = np.random.default_rng(0).gamma(2.0, 2.0, (5, 8))
    (result,) = final_results([judged(7, figures_of(list(of_seed))) for of_seed in scores])
    assert (result.number, result.n_seeds) == (7, 5)
    assert result.means.keys() == {"test/mean_steps", "test/success_rate"}
    mean, low, high = result.means["test/mean_steps"]
    assert mean == pytest.approx(aggregate_iqm(scores))
    assert low < mean < high
    assert result.means["test/success_rate"] == (1.0, 1.0, 1.0)


def test_verdict_of_the_same_trials_is_the_same_and_lacks_those_that_have_not_finished():
    scores = np.random.default_rng(0).gamma(2.0, 2.0, (2, 6, 8))
    trials = [judged(number, figures_of(list(scores[number - 1, seed]))) for number in (1, 2) for seed in range(6)]
    trials.append(judged(2, figures_of([0.0]), TrialState.FAIL))
    first, second = final_results(trials), final_results(trials)
    assert first == second
    assert first != final_results(trials, seed=1)
    assert [result.n_seeds for result in first] == [6, 6]


def test_verdict_of_one_seed_has_no_interval():
    (result,) = final_results([judged(0, figures_of([2.0]))])
    mean, low, high = result.means["test/mean_steps"]
    assert mean == 2.0
    assert np.isnan([low, high]).all()


def test_verdict_leaves_out_figures_that_some_seeds_lack():
    uneven = [judged(0, figures_of([2.0]) | {f"test/only_{seed}": 1.0}) for seed in range(2)]
    (result,) = final_results(uneven)
    assert result.means.keys() == {"test/mean_steps", "test/success_rate"}


def test_verdict_leaves_the_draws_of_others_alone(monkeypatch):
    for name in ("choice", "randint", "seed"):
        monkeypatch.setattr(np.random, name, pytest.fail)
    (result,) = final_results([judged(0, figures_of([float(seed), 3.0])) for seed in range(3)])
    assert result.n_seeds == 3


def test_verdict_on_one_volume_has_the_interval_of_rliable():
    scores = np.random.default_rng(0).gamma(2.0, 2.0, (20, 1))
    (result,) = final_results([judged(7, figures_of(list(of_seed))) for of_seed in scores])
    _, ends = get_interval_estimates({"it": scores}, lambda each: np.array([aggregate_iqm(each)]), reps=10_000)
    # But for what is left to chance, as rliable takes no seed: of few scores, an interval may end on one or on another.
    assert result.means["test/mean_steps"][1:] == pytest.approx(ends["it"][:, 0], rel=0.05)

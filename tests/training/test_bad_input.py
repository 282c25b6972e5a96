"""Arbitrary arguments of the objects that a run is made from."""

import pytest
from hypothesis import given

from armscan.training import Budget, SolvedCriterion, phantom_data
from armscan.training import splits as data
from tests.support.junk import SETTINGS, is_answered, junk, result_of


@pytest.mark.parametrize(
    "changed", ["env_steps", "eval_every_env_steps", "validation_episodes", "solved", "best_by", "schedule"]
)
@SETTINGS
@given(value=junk)
def test_budget_with_junk(changed, value):
    figures = {"env_steps": 9, "eval_every_env_steps": 3, "validation_episodes": 2}
    budget = result_of(lambda: Budget(**figures | {changed: value}))
    assert budget is None or changed not in ("solved", "best_by") or value in (None, "success", "distance")


@pytest.mark.parametrize("changed", ["success_rate", "mean_steps", "n_epochs"])
@SETTINGS
@given(value=junk)
def test_solved_criterion_with_junk(changed, value):
    criterion = result_of(lambda: SolvedCriterion(**{changed: value}))
    assert criterion is None or criterion.holds([]) is False


@pytest.mark.parametrize("changed", ["n_training", "n_validation", "n_test", "first_seed", "cache_dir", "version"])
@SETTINGS
@given(value=junk)
def test_phantom_data_with_junk(changed, value, phantom, monkeypatch):
    """No phantoms are made: thousands may have been asked for."""

    def load(seeds, folder, version):
        assert seeds[-1] < 2**31
        assert version in (1, 2)
        return {f"phantom-{seeds[0]}": phantom}

    monkeypatch.setattr(data, "load_phantoms", load)
    assert is_answered(lambda: phantom_data(**{changed: value}))

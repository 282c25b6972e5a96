from dataclasses import replace

import pytest

from benchmarks.sweeps.bench.replay import Rule, search
from benchmarks.sweeps.bench.warm_start import BEGUN, COLD, SimulatedSweep, best_that_fit, replays, share_of

pytestmark = pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
RULE = Rule("tpe", "none")


def test_the_best_settings_that_fit_are_tried_first(surrogate):
    found = search(surrogate, "sac_y", RULE, n_trainings=20, seed=0)
    space = surrogate.space
    fitting = best_that_fit(found, space)
    assert list(fitting) == [each.values for each in found.candidates[:10]]
    begun = search(surrogate, "sac_y", RULE, n_trainings=20, seed=1, enqueued=fitting)
    first = sorted(begun.candidates, key=lambda each: each.number)[:10]
    assert [each.values for each in first] == list(fitting)


def test_values_outside_of_the_space_become_the_nearest_in_it(surrogate):
    found = search(surrogate, "sac_y", RULE, n_trainings=20, seed=0)
    outside = tuple(replace(each, values=each.values | {"agent.lr": 1.0}) for each in found.candidates)
    fitting = best_that_fit(replace(found, candidates=outside), surrogate.space)
    assert fitting[0] == found.candidates[0].values | {"agent.lr": 0.01}


def test_a_warm_start_from_the_same_space_saves_trials(surrogate):
    target = SimulatedSweep("sac_y", surrogate, RULE, 40)
    studies = replays(target, target, 8)
    share = share_of(studies["trials"].warm, studies["trials"].cold)
    assert share.low <= share.value <= share.high
    assert share.value < 1.0
    assert studies["trials"].cold.between(1, 40).all()
    assert share.value == pytest.approx(studies["trials"].warm.median() / studies["trials"].cold.median())
    # A cold study finds its own best, but another one may never find as good settings.
    assert studies["trials"]["independent"].between(1, 41).all()
    is_late = studies["trials"]["independent"] == 41
    assert is_late.any()
    assert ((studies["reached"]["independent"] == 0) == is_late).all()
    # Each kind of study begins differently.
    assert list(studies["trials"]) == [*COLD, *BEGUN]
    assert not studies["trials"].T.duplicated().any()
    # Without pruning, each trial is a training.
    assert (studies["trainings"] == studies["trials"]).all(axis=None)


def test_studies_that_begin_with_nothing_may_have_another_pruner(surrogate):
    target, pruned = (SimulatedSweep("sac_y", surrogate, Rule("tpe", pruner), 20) for pruner in ("none", "median"))
    alike, studies = replays(pruned, pruned, 3), replays(pruned, target, 3, cold=pruned)
    assert studies["trials"][[*COLD]].equals(alike["trials"][[*COLD]])
    # One more than all trials without pruning.
    assert (studies["trials"].preset == 21).all()
    assert (alike["trials"].preset > 21).all()

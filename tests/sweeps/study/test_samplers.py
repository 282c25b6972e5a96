"""Samplers whose state is in a storage that a stranger may have written to."""

import pickle

import optuna
import pytest
from optuna.samplers import BaseSampler
from optuna.trial import create_trial

from armscan.errors import InvalidValueError, StudyError
from armscan.sweeps.study.components import make, read_settings
from armscan.sweeps.study.samplers import CmaEsSampler

CMAES = {"_target_": "armscan.sweeps.study.samplers.CmaEsSampler", "warn_independent_sampling": False}
SPACE = {name: optuna.distributions.FloatDistribution(-3.0, 3.0) for name in "xyz"}


class Opened:
    """An object that executes code when it is unpickled."""

    def __init__(self, marker):
        self.marker = str(marker)

    def __reduce__(self):
        return open, (self.marker, "w")


def value_of(trial):
    return sum((trial.suggest_float(name, -3.0, 3.0) - 1) ** 2 for name in SPACE)


@pytest.mark.parametrize("state", ["code", "a list", "text", "half"])
def test_state_of_cmaes_that_a_stranger_has_written_is_not_executed(tmp_path, state):
    marker = tmp_path / "executed"
    states = {"code": pickle.dumps(Opened(marker)).hex(), "a list": pickle.dumps([1]).hex(), "text": "x", "half": "80"}
    study = optuna.create_study(sampler=make("sampler", CMAES, BaseSampler, seed=0))
    for key in ("cma:optimizer", "cma:optimizer:0"):
        attributes = {key: states[state]}
        study.add_trial(
            create_trial(value=1.0, params=dict.fromkeys(SPACE, 0.0), distributions=SPACE, system_attrs=attributes)
        )
    with pytest.raises(StudyError, match="trial 1: the state of CMA-ES"):
        study.optimize(value_of, n_trials=2)
    assert not marker.exists()


@pytest.mark.parametrize("variant", [{}, {"use_separable_cma": True}, {"with_margin": True}], ids=str)
def test_cmaes_draws_what_optunas_own_draws(variant):
    points = []
    for sampler in (CmaEsSampler, optuna.samplers.CmaEsSampler):
        study = optuna.create_study(sampler=sampler(seed=0, warn_independent_sampling=False, **variant))
        study.optimize(value_of, n_trials=40)
        points.append([trial.params for trial in study.trials])
    assert points[0] == points[1]


def test_cmaes_is_refused_for_several_objectives():
    words = ["sweep=speed_vs_success", "study/sampler=cmaes"]
    with pytest.raises(InvalidValueError, match=r"cmaes, which searches for one objective, but .* has 2: give study/"):
        read_settings(words)


def test_optunas_own_cmaes_is_refused():
    words = ["sweep=sac_y", "study/sampler=cmaes", "study.sampler._target_=optuna.samplers.CmaEsSampler"]
    with pytest.raises(InvalidValueError, match=r"CmaEsSampler, which executes .* study/sampler=cmaes"):
        read_settings(words)
    assert read_settings(words[:2])[0].sampler == CMAES

"""Constraints of a study: how they are written, and that a trial that violates one is never best."""

import math

import optuna
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armscan.errors import InvalidValueError
from armscan.sweeps.scheduling.claim import PendingWrites
from armscan.sweeps.scheduling.state import is_feasible
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.components import read_settings
from armscan.sweeps.study.constraints import Constraint, constrained
from armscan.sweeps.study.study import best_trials

NUMBERS = st.floats(-1e6, 1e6)


class Attempt:
    """Attempt, with the attributes that a constraint reads."""

    def __init__(self, trial):
        self.trial, self.writes = trial, PendingWrites()


@given(NUMBERS, NUMBERS, st.sampled_from(["<=", ">="]))
def test_violation_is_above_zero_exactly_where_the_constraint_does_not_hold(value, bound, sign):
    violation = Constraint.read(f"env_steps {sign} {bound!r}").violation({"env_steps": value})
    assert (violation > 0) is not (value <= bound if sign == "<=" else value >= bound)


def test_violation_is_a_share_of_the_bound_and_infinite_for_what_is_no_number():
    constraint = Constraint.read("training_s<=60")
    assert constraint.violation({"training_s": 90.0}) == 0.5
    assert constraint.violation({"training_s": math.nan}) == math.inf
    assert str(constraint) == "training_s <= 60"


@pytest.mark.parametrize("text", ["training_s < 60", "training_s <= much", "training_s <= inf", "<= 3", 3, None])
def test_text_that_is_no_constraint_is_refused(text):
    with pytest.raises(InvalidValueError, match=r"study.constraints has .*, but each must be a metric, <= or >="):
        Constraint.read(text)


def test_constraints_are_read_from_the_command_line_and_name_metrics_of_a_trial():
    word = 'study.constraints=["training_s <= 60", "success_rate >= 0.9"]'
    settings, _, _ = read_settings(["sweep=sac_y", word])
    assert list(map(str, settings.constraints)) == ["training_s <= 60", "success_rate >= 0.9"]
    with pytest.raises(InvalidValueError, match=r"study.constraints has 'mb <= 500', but a trial returns only"):
        read_settings(["sweep=sac_y", 'study.constraints=["mb <= 500"]'])
    with pytest.raises(InvalidValueError, match=r"study.constraints is 'much', but it must be a list such as"):
        read_settings(["sweep=sac_y", "study.constraints=much"])


def test_constraints_are_stored_in_the_order_in_which_they_are_written():
    texts = [f"env_steps <= {bound}" for bound in range(20)]
    study = optuna.create_study()
    attempt = Attempt(study.ask())
    constrained(lambda _: {"env_steps": 5.0}, [Constraint.read(text) for text in texts])(attempt)
    attempt.writes.write()
    assert list(study.trials[0].constraints) == texts


@pytest.mark.parametrize("directions", [["minimize"], ["minimize", "minimize"]], ids=["one", "two"])
def test_trial_that_violates_a_constraint_is_never_best(storage_uri, directions):
    storage = open_storage(storage_uri)
    study = optuna.create_study(study_name="a", storage=storage.optuna, directions=directions)
    constraints = [Constraint.read("training_s <= 60")]
    for value, training_s in ((1.0, 61.0), (2.0, 60.0), (3.0, math.nan), (0.5, math.nan)):
        attempt = Attempt(study.ask())
        attempt.trial.suggest_float("x", 0.0, 5.0)
        assert constrained(lambda _, s=training_s: {"training_s": s}, constraints)(attempt) is not None
        # Twice, as after a cut connection.
        attempt.writes.write()
        attempt.writes.write()
        study.tell(attempt.trial, [value] * len(directions))
    assert [is_feasible(trial) for trial in study.trials] == [False, True, False, False]
    assert [trial.number for trial in best_trials(study, 3)] == [1]


@pytest.mark.parametrize("text", ["env_steps <= 1234567", "training_s >= 0.1", "training_s <= 60"])
def test_constraint_is_written_as_exactly_as_it_is_read(text):
    assert Constraint.read(str(Constraint.read(text))) == Constraint.read(text)

"""Terminators: a study ends when no more can be gained, decided from its storage alone, and stays ended."""

import statistics

import numpy as np
import optuna
import pytest
from hypothesis import given
from hypothesis import strategies as st
from optuna.study import StudyDirection
from optuna.trial import create_trial

from armscan.errors import InvalidValueError
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import StudyState
from armscan.sweeps.scheduling.termination import Termination, ended_because, reopen
from armscan.sweeps.storage.attribute_names import SEEDS, TAKEN_FROM
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.components import read_settings
from armscan.sweeps.study.terminators import BelowSeedNoise, Stagnation, seed_noise

X = {"x": optuna.distributions.FloatDistribution(0.0, 1.0)}


def study_of(rows, directions=("minimize",)):
    study = optuna.create_study(directions=directions)
    for values in rows:
        study.add_trial(create_trial(values=list(values)))
    return study


def reason_of(terminator, study):
    return terminator.reason(study, ["mean_steps", "env_steps"], StudyState.of(study.trials))


def dominates_or_equals(first, second):
    return all(a <= b for a, b in zip(first, second, strict=True))


@given(
    st.integers(1, 2).flatmap(
        lambda n: st.lists(st.tuples(*[st.integers(0, 3).map(float)] * n), min_size=1, max_size=10)
    ),
    st.integers(1, 4),
)
def test_study_stagnates_exactly_where_each_of_the_last_trials_has_one_before_that_is_as_good(rows, n_trials):
    study = study_of(rows, ["minimize"] * len(rows[0]))
    n_before = len(rows) - n_trials
    is_over = n_before > 0 and all(
        any(dominates_or_equals(before, last) for before in rows[:n_before]) for last in rows[n_before:]
    )
    assert (reason_of(Stagnation(n_trials), study) is not None) is is_over


def test_stagnation_follows_the_direction_and_says_so():
    study = study_of([(1.0,), (3.0,), (2.0,), (2.0,)], ["maximize"])
    assert reason_of(Stagnation(3), study) is None
    assert reason_of(Stagnation(2), study) == "the last 2 of 4 completed trials were no better than those before"


@pytest.mark.parametrize(("n_here", "is_over"), [(0, False), (1, False), (2, True)])
def test_trials_taken_from_another_study_are_among_those_before(n_here, is_over):
    study = study_of([(1.0,), (2.0,), (3.0,)])
    taken = [create_trial(values=trial.values, user_attrs={TAKEN_FROM: f"b:{trial.number}"}) for trial in study.trials]
    study = optuna.create_study()
    study.add_trials([*taken, *(create_trial(value=1.5) for _ in range(n_here))])
    assert (reason_of(Stagnation(2), study) is not None) is is_over


def noisy(n_trials, noise, seed=0):
    """Return a study of a noisy parabola, with two seeds of each trial."""
    rng, study = np.random.default_rng(seed), optuna.create_study()
    for x in rng.random(n_trials):
        seeds = {str(each): {"mean_steps": float((x - 0.5) ** 2 + noise * rng.normal())} for each in (0, 1)}
        value = statistics.fmean(each["mean_steps"] for each in seeds.values())
        study.add_trial(create_trial(value=value, params={"x": x}, distributions=X, user_attrs={SEEDS: seeds}))
    return study


@pytest.mark.parametrize("direction", [StudyDirection.MINIMIZE, StudyDirection.MAXIMIZE])
def test_noise_between_seeds_is_that_of_one_training_of_the_better_trials(direction):
    study = noisy(400, 0.3)
    assert seed_noise(study.trials, "mean_steps", direction) == pytest.approx(0.3, rel=0.1)
    assert seed_noise(study_of([(1.0,)]).trials, "mean_steps", direction) is None


@pytest.mark.parametrize("seed", range(3))
def test_study_ends_where_the_noise_is_larger_than_what_may_be_gained(seed):
    study = noisy(30, 1.0, seed)
    reason = reason_of(BelowSeedNoise(20), study)
    assert reason.startswith("after 30 trials, further ones may gain at most 0.")
    assert reason_of(BelowSeedNoise(40), study) is None


def test_study_goes_on_where_seeds_hardly_differ():
    assert reason_of(BelowSeedNoise(20), noisy(30, 1e-3)) is None


@pytest.fixture
def make(storage_uri):
    """Return a function that opens the same study, as each worker does; it ends after `last` finished trials."""

    def opened(asked="a", last=2):
        storage = open_storage(storage_uri)
        study = optuna.create_study(study_name="a", storage=storage.optuna, load_if_exists=True)

        def find_reason(state):
            opened.looks += 1
            return f"{len(state.finished)} are enough" if len(state.finished) >= last else None

        termination = Termination(study, storage, find_reason, asked)
        return TrialScheduler(study, storage, Limits(n_trials=100), termination=termination)

    opened.looks = 0
    return opened


def run_one(scheduler):
    scheduler.check_termination()
    trial = scheduler.claim({"worker": "a"})
    if trial is not None:
        scheduler.study.tell(trial, 1.0)
    return trial


def test_every_worker_ends_where_one_has_found_that_the_study_ends(make):
    first, second = make(), make()
    assert [run_one(first) is not None for _ in range(3)] == [True, True, False]
    # Found by the other, without a check of its own.
    assert second.claim({"worker": "b"}) is None
    assert second.end_reason(second.state()) == "2 are enough"


def test_ended_study_stays_ended_until_another_number_of_trials_is_asked_for(make):
    """Its rule stays fulfilled, so it is checked again once a further trial has finished."""
    while run_one(make()) is not None:
        pass
    scheduler = make()
    assert not reopen(scheduler.study, scheduler.storage, "a")
    assert run_one(make()) is None
    assert reopen(scheduler.study, scheduler.storage, "more trials")
    assert ended_because(scheduler.study, "more trials") is None
    assert "reason" not in scheduler.study.user_attrs["terminated"]
    assert [run_one(make(asked="more trials")) is not None for _ in range(2)] == [True, False]
    assert ended_because(scheduler.study, "more trials") == "3 are enough"


def test_study_is_looked_at_once_for_each_number_of_finished_trials(make):
    scheduler = make(last=10)
    for _ in range(3):
        run_one(scheduler)
        scheduler.check_termination()
        scheduler.check_termination()
    assert make.looks == 4


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["study/terminator=noise"],
            "two study.seeds, but the study has one seed: give study/terminator=stagnation",
        ),
        (
            ["study/terminator=noise", "study/pruner=none", "study.objectives=[minimize mean_steps,maximize solved]"],
            "but the study has 2 objectives",
        ),
        (["study/terminator=stagnation", "study.terminator.n_trials=0"], "n_trials is 0, but it must be a whole"),
        (
            ["study/terminator=stagnation", "study.n_trials=30"],
            r"study.terminator.n_trials is 30, but it must be less than study.n_trials \(30\)",
        ),
        (
            ["study/terminator=noise", "study.seeds=[0,1]", "study.n_trials=8"],
            r"study.terminator.min_trials is 20, but it must be less than study.n_trials \(8\)",
        ),
        (["+study.terminator={_target_: builtins.dict}"], "study.terminator is builtins.dict, which has no check"),
        (["+study.terminator=3"], "study.terminator is 3, but it must be a section with a _target_, or null"),
    ],
    ids=["one seed", "two objectives", "number", "too few trials", "too few trials for noise", "class", "type"],
)
def test_terminator_that_cannot_work_is_refused(words, line):
    with pytest.raises(InvalidValueError, match=line):
        read_settings(["sweep=sac_y", *words])

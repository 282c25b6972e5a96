"""The result of a study in the terminal, and the exit code of its command."""

import os

import pytest
from optuna.trial import TrialState

from armscan.sweeps.results.console import print_result
from armscan.sweeps.scheduling.limits import FAILURES_BEFORE_REPORTS
from armscan.sweeps.scheduling.state import CONTROL
from armscan.sweeps.storage.attribute_names import ENV_STEPS, FINAL_SEED, FINALIST, METRICS
from armscan.sweeps.study.settings import FinalEvalSettings


@pytest.fixture
def study(opened):
    return opened(final_eval=FinalEvalSettings(top_k=1, min_seeds=1, mean_seeds=1, test_seeds=1, episodes=3))


@pytest.fixture
def searched(study):
    """Return the study after its search."""
    search = study.search.scheduler.study
    for _ in range(study.settings.n_trials):
        trial = search.ask()
        study.search.space.suggest(trial)
        search.tell(trial, 1.0)
    return study


def test_study_whose_workers_have_ended_before_its_trials_can_be_resumed(study, capsys):
    assert print_result(study) == os.EX_TEMPFAIL
    assert "only 0 of 5 trials have finished" in capsys.readouterr().err


def test_limit_that_ended_the_search_is_named(opened, capsys):
    study = opened(
        max_env_steps=100, final_eval=FinalEvalSettings(top_k=0, min_seeds=1, mean_seeds=1, test_seeds=1, episodes=3)
    )
    trial = study.search.scheduler.claim({})
    trial.set_user_attr(ENV_STEPS, 120)
    study.search.scheduler.study.tell(trial, 1.0)
    assert print_result(study) == 0
    printed = capsys.readouterr().out
    assert "the search has ended: study.max_env_steps, 100, has been reached" in printed


def test_study_whose_final_trainings_are_missing_can_be_resumed(searched, capsys):
    assert print_result(searched) == os.EX_TEMPFAIL
    assert "trainings are missing; the same command resumes the study" in capsys.readouterr().err


def test_study_whose_test_is_incomplete_can_be_resumed(searched, capsys):
    selection, test = (phase.scheduler for phase in searched.finals)

    def train(scheduler):
        if trial := scheduler.claim({}):
            trial.set_user_attr(METRICS, {"test/success_rate": 1.0})
            trial.study.tell(trial, 2.0 if trial.user_attrs[FINALIST] == CONTROL else 1.0)
        return trial is not None

    while train(selection):
        pass
    for n_left, code in ((1, os.EX_TEMPFAIL), (0, 0)):
        assert train(test)
        assert print_result(searched) == code
        assert (f"trainings on the test volumes are missing ({n_left}); the" in capsys.readouterr().err) == bool(code)


def test_failed_study_is_not_worth_the_same_command(study):
    search = study.search.scheduler.study
    for _ in range(FAILURES_BEFORE_REPORTS):
        search.tell(search.ask(), state=TrialState.FAIL)
    assert print_result(study) == 1


def test_study_with_a_failed_final_training_is_not_worth_the_same_command(searched):
    test = searched.finals[1].scheduler.study
    failed = test.ask()
    failed.set_user_attr(FINALIST, CONTROL)
    failed.set_user_attr(FINAL_SEED, 0)
    test.tell(failed, state=TrialState.FAIL)
    assert print_result(searched) == 1

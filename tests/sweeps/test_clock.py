"""A study while the wall clock jumps: leases and waits are measured on clocks that do not."""

from datetime import datetime, timedelta

import optuna
import pytest
from optuna.trial import TrialState, create_trial

from armscan.sweeps.scheduling.state import BEAT_S, StudyState
from armscan.sweeps.storage.attribute_names import LEASE
from tests.support.clock import WallClock
from tests.support.processes import start_run
from tests.support.waiting import HANG_S, wait_until
from tests.sweeps.test_command import TINY, trials_of
from tests.test_run import runs_in

N_TRIALS = 5


@pytest.mark.slow
def test_study_whose_clock_jumps_an_hour_either_way_finishes_every_trial_once(tmp_path):
    clock, printed = WallClock(tmp_path / "clock"), tmp_path / "printed"
    words = [*TINY, f"study.n_trials={N_TRIALS}", "study.workers=2", "study.final_eval.top_k=0"]
    study = start_run(*words, cwd=tmp_path, environment=clock.environment)

    def finished():
        return sum(trial.state.is_finished() for trial in trials_of(tmp_path))

    hours = [1, -1, 0]
    wait_until(lambda: trials_of(tmp_path), process=study, log=printed.read_text)
    for number, jump in enumerate(hours):
        wait_until(lambda number=number: finished() >= number, process=study, log=printed.read_text)
        clock.set(jump)
    assert study.wait(HANG_S) == 0, printed.read_text()
    trials = trials_of(tmp_path)
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * N_TRIALS
    # The jumps are visible, otherwise nothing was tested.
    began = [trial.datetime_start for trial in trials]
    assert max(began) - min(began) > timedelta(minutes=55)
    runs = runs_in(tmp_path)[1]
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert len([run for run in runs if "trial" in run.data.tags and "seed" in run.data.tags]) == N_TRIALS


def test_time_of_a_trial_during_which_the_clock_was_turned_back_is_not_counted():
    study, start = optuna.create_study(), datetime(2026, 11, 22, 12)
    for hours in (2, -1):
        trial = create_trial(value=1.0)
        trial.datetime_start, trial.datetime_complete = start, start + timedelta(hours=hours)
        study.add_trial(trial)
    assert StudyState.of(study.trials).busy_hours == 2.0
    assert StudyState.of(study.trials[1:]).busy_hours == 0.0


@pytest.mark.parametrize("state", [TrialState.WAITING, TrialState.FAIL])
def test_time_is_not_counted_after_a_worker_was_last_heard_of(state):
    study, start = optuna.create_study(), datetime(2026, 11, 22, 12)
    last_beat = start + timedelta(hours=2)
    trial = create_trial(state=state, user_attrs={LEASE: {BEAT_S: last_beat.timestamp()}})
    # Requeued, or its worker was found dead, days later.
    trial.datetime_start = start
    trial.datetime_complete = start + timedelta(days=3) if state == TrialState.FAIL else None
    study.add_trial(trial)
    assert StudyState.of(study.trials).busy_hours == pytest.approx(2.0)

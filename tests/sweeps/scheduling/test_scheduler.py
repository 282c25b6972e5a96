"""The scheduler of a study: exactly as many trials as asked for, even if workers die in between."""

import multiprocessing
import os
import random
import signal
import time
from dataclasses import asdict
from datetime import datetime, timedelta

import optuna
import pytest
from optuna.trial import TrialState, create_trial

from armscan.sweeps.scheduling.claim import PendingWrites, PlannedTrial, TrialOutcome
from armscan.sweeps.scheduling.state import BEAT_S, StudyState, retried_by, seconds_of
from armscan.sweeps.storage.attribute_names import (
    ATTEMPT,
    CODE,
    EARLIER_SPANS,
    FAILURE,
    FINAL_SEED,
    FINALIST,
    LEASE,
    RETRIED,
    RETRY_OF,
    STOP,
    TAKEN_FROM,
)
from armscan.sweeps.storage.reports import reports_of, store_report
from armscan.sweeps.workers import heartbeat as lease_module
from armscan.sweeps.workers.heartbeat import Heartbeat, LivenessCheck
from armscan.tracking import code_version
from armscan.utils.processes import ProcessInfo, process_start
from tests.support.waiting import wait_until
from tests.sweeps.conftest import fail


def states(scheduler):
    return [trial.state.name for trial in scheduler.study.get_trials(deepcopy=False)]


def finish(scheduler, trial, value=1.0):
    trial.report(value, 1)
    scheduler.study.tell(trial, value)


def test_claim_gives_as_many_trials_as_are_wanted(make_scheduler):
    scheduler, other = make_scheduler(n_trials=3), make_scheduler(n_trials=3)
    trials = [scheduler.claim({"worker": "a"}), other.claim({"worker": "b"}), scheduler.claim({"worker": "a"})]
    assert [trial.number for trial in trials] == [0, 1, 2]
    assert other.claim({"worker": "b"}) is None
    assert other.end_reason(other.state()) is None
    for trial in trials:
        finish(scheduler, trial)
    assert other.end_reason(other.state()) == "3 trials have finished"


def test_trial_that_is_handed_back_is_the_next_to_be_run_with_the_same_values(make_scheduler):
    scheduler, other = make_scheduler(), make_scheduler()
    trial = scheduler.claim({"worker": "a"})
    value = trial.suggest_float("x", 0, 1)
    scheduler.requeue(trial, {})
    assert states(scheduler) == ["WAITING"]
    again = other.claim({"worker": "b"})
    assert (again.number, again.suggest_float("x", 0, 1)) == (trial.number, value)


def test_failed_trial_is_replaced_until_too_many_have_failed(make_scheduler):
    scheduler = make_scheduler(n_trials=2, max_failures=1)
    finish(scheduler, scheduler.claim({}))
    fail(scheduler, scheduler.claim({}), "no luck")
    assert scheduler.end_reason(scheduler.state()) is None
    fail(scheduler, scheduler.claim({}), "none again")
    reason = "2 trials have failed, and at most 1 may: trial 2: none again"
    assert scheduler.end_reason(scheduler.state()) == scheduler.failure_reason(scheduler.state()) == reason
    assert scheduler.claim({}) is None


def test_study_whose_first_trials_all_fail_at_once_ends(make_scheduler):
    scheduler = make_scheduler(n_trials=100, max_failures=50)
    for _ in range(3):
        assert scheduler.failure_reason(scheduler.state()) is None
        fail(scheduler, scheduler.claim({}), "agent.lr is -1")
    assert scheduler.failure_reason(scheduler.state()).endswith(
        "before they reported anything: trial 0: agent.lr is -1"
    )


def test_limits_of_time_and_environment_steps_end_a_study(make_scheduler):
    scheduler = make_scheduler(max_env_steps=100)
    scheduler.claim({"env_steps": 99})
    assert scheduler.end_reason(scheduler.state()) is None
    # A retry begins with the seeds that its trial had finished.
    scheduler.claim({}).set_user_attr("seeds", {"0": {"env_steps": 1}})
    assert scheduler.end_reason(scheduler.state()) == "study.max_env_steps, 100, has been reached"
    assert make_scheduler(timeout_hours=1.0).end_reason(scheduler.state()) is None
    time.sleep(0.1)
    assert (
        make_scheduler(timeout_hours=1e-5).end_reason(scheduler.state())
        == "study.timeout_hours, 1e-05, has been reached"
    )


def test_trial_of_a_dead_worker_is_retried_once_with_its_values(make_scheduler):
    scheduler, other = make_scheduler(), make_scheduler()
    trial = scheduler.claim({"worker": "a", "host": "there"})
    value = trial.suggest_float("x", 0, 1)
    assert other.reclaim(lambda _: False) == []
    assert [each.number for each in other.reclaim(lambda _: True)] == [0]
    assert scheduler.reclaim(lambda _: True) == []
    assert states(scheduler) == ["FAIL", "WAITING"]
    state = scheduler.state()
    assert (len(state.failed), len(state.retried)) == (0, 1)
    assert state.retried[0].user_attrs[FAILURE] == "its worker died: a on there"
    again = other.claim({"worker": "b"})
    assert again.user_attrs[RETRY_OF] == 0
    assert again.suggest_float("x", 0, 1) == value
    other.reclaim(lambda _: True)
    assert len(other.state().failed) == 1
    assert RETRIED not in other.state().failed[0].user_attrs
    # A worker that was taken for dead finds that the trial is no longer its own.
    with pytest.raises(optuna.exceptions.UpdateFinishedTrialError):
        trial.report(1.0, 1)
    scheduler.requeue(trial, {})
    scheduler.renew(trial, {})
    assert states(scheduler) == ["FAIL", "FAIL"]


def test_trial_whose_worker_died_while_it_took_it_is_reclaimed_at_once(make_scheduler):
    scheduler = make_scheduler()
    scheduler.study.ask()
    assert [trial.number for trial in scheduler.reclaim(lambda _: False)] == [0]


def test_retry_has_the_reports_and_rungs_of_the_attempt_before(make_scheduler):
    scheduler = make_scheduler(max_retries=1)
    trial = scheduler.claim({"worker": "a"})
    storage = scheduler.study._storage
    for step in (400, 800):
        store_report(storage, trial._trial_id, step, [step / 100.0])
    storage.set_trial_system_attr(trial._trial_id, "completed_rung_0", 4.0)
    scheduler.reclaim(lambda _: True)
    again = scheduler.claim({"worker": "b"})
    stored = storage.get_trial(again._trial_id)
    assert stored.user_attrs[RETRY_OF] == trial.number
    assert reports_of(stored) == {400: (4.0,), 800: (8.0,)}
    assert stored.system_attrs["completed_rung_0"] == 4.0


def test_death_between_a_retry_and_the_failure_makes_no_second_retry(make_scheduler, monkeypatch):
    scheduler, other = make_scheduler(), make_scheduler()
    scheduler.claim({"worker": "a"})
    monkeypatch.setattr(
        scheduler.study._storage, "set_trial_state_values", lambda *_: (_ for _ in ()).throw(SystemExit)
    )
    with pytest.raises(SystemExit):
        scheduler.reclaim(lambda _: True)
    other.reclaim(lambda _: True)
    assert states(other) == ["FAIL", "WAITING"]


def reclaim_together(barrier, make_scheduler, n):
    scheduler = make_scheduler()
    barrier.wait()
    for _ in range(n):
        scheduler.reclaim(lambda trial: trial.number < 4)


def test_workers_that_notice_a_death_at_once_make_one_retry(make_scheduler):
    scheduler = make_scheduler()
    for _ in range(4):
        scheduler.claim({"worker": "a"})
    context = multiprocessing.get_context("fork")
    barrier = context.Barrier(3)
    processes = [context.Process(target=reclaim_together, args=(barrier, make_scheduler, 3)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert states(scheduler) == ["FAIL"] * 4 + ["WAITING"] * 4
    assert sorted(trial.user_attrs[RETRY_OF] for trial in scheduler.state().waiting) == [0, 1, 2, 3]
    assert {trial.user_attrs[ATTEMPT] for trial in scheduler.state().waiting} == {1}


def work(make_scheduler, n_trials):
    scheduler, liveness, chance = (
        make_scheduler(n_trials=n_trials, max_retries=9),
        LivenessCheck(),
        random.Random(os.getpid()),
    )
    lease = asdict(ProcessInfo.current())
    while scheduler.end_reason(scheduler.state()) is None:
        scheduler.reclaim(liveness.is_dead)
        trial = scheduler.claim(lease)
        if trial is None:
            time.sleep(0.01)
            continue
        trial.suggest_float("x", 0, 1)
        time.sleep(chance.uniform(0.0, 0.1))
        finish(scheduler, trial)


def test_workers_killed_at_any_moment_lose_no_trial_and_make_none_too_many(make_scheduler):
    n_trials, n_killed, context = 40, 0, multiprocessing.get_context("fork")
    scheduler, chance = make_scheduler(n_trials=n_trials), random.Random(0)

    def started():
        process = context.Process(target=work, args=(make_scheduler, n_trials))
        process.start()
        return process

    workers = [started() for _ in range(3)]
    while scheduler.end_reason(scheduler.state()) is None:
        time.sleep(chance.uniform(0.05, 0.4))
        one = chance.randrange(3)
        if workers[one].is_alive():
            os.kill(workers[one].pid, signal.SIGKILL)
            n_killed += 1
            workers[one].join()
            workers[one] = started()
    for worker in workers:
        worker.join()
    state = scheduler.state()
    assert n_killed > 2
    assert len(state.finished) == n_trials
    assert not state.failed
    assert not state.running
    assert len({trial.params["x"] for trial in state.finished}) == n_trials


def test_study_with_a_plan_runs_what_is_planned_each_once_and_what_is_planned_after_it(make_scheduler):
    def plan():
        """Two trials, and a third once both have ended."""
        trials = scheduler.study.get_trials(deepcopy=False)
        ended = sum(trial.state.is_finished() for trial in trials)
        planned = [PlannedTrial({"x": float(n)}, {FINALIST: n, FINAL_SEED: 7}) for n in range(2 if ended < 2 else 3)]
        return planned[len(trials) :]

    scheduler = make_scheduler(n_trials=9, plan=plan)
    other = make_scheduler(n_trials=9, plan=plan)
    trials = [scheduler.claim({}), other.claim({})]
    assert [trial.user_attrs[FINALIST] for trial in trials] == [0, 1]
    assert scheduler.claim({}) is None
    assert not scheduler.claim_status(scheduler.state()).can_claim
    for number, trial in enumerate(trials):
        assert trial.suggest_float("x", 0, 5) == number
        finish(scheduler, trial)
    assert scheduler.end_reason(scheduler.state()) is None
    last = other.claim({})
    assert last.suggest_float("x", 0, 5) == 2.0
    finish(other, last)
    assert scheduler.end_reason(scheduler.state()) == "3 trials have finished, 0 failed"


def test_a_claim_plans_once(make_scheduler):
    n_plans = 0

    def plan():
        nonlocal n_plans
        n_plans += 1
        return [PlannedTrial({"x": 0.0}, {FINALIST: 0, FINAL_SEED: n_plans})]

    scheduler = make_scheduler(n_trials=2, plan=plan)
    for n_claims in (1, 2):
        assert scheduler.claim({}) is not None
        assert n_plans == n_claims
    assert scheduler.claim({}) is None
    assert n_plans == 2, "as many run as are wanted"


def test_retry_of_a_planned_trial_whose_worker_died_before_it_asked_for_its_values_has_them(make_scheduler):
    scheduler = make_scheduler()
    scheduler.study.enqueue_trial({"x": 0.125}, user_attrs={FINALIST: 3, FINAL_SEED: 7})
    scheduler.claim({"worker": "a", "host": "there"})
    scheduler.reclaim(lambda _: True)
    again = scheduler.claim({})
    assert again.user_attrs[RETRY_OF] == 0
    assert again.user_attrs[FINALIST] == 3
    assert again.suggest_float("x", 0, 1) == 0.125


def test_tally_counts_the_time_in_which_anything_ran_once(make_scheduler):
    scheduler = make_scheduler()
    trials = [scheduler.claim({}) for _ in range(2)]
    time.sleep(0.2)
    for trial in trials:
        finish(scheduler, trial)
    first, second = scheduler.state().finished
    spent_s = (second.datetime_complete - first.datetime_start).total_seconds()
    assert scheduler.state().busy_hours * 3600 == pytest.approx(spent_s, abs=0.05)
    assert {trial.state for trial in StudyState.of(scheduler.study.trials).all} == {TrialState.COMPLETE}


def test_witness_knows_a_process_that_is_gone_and_one_that_has_its_number(make_scheduler):
    scheduler, liveness = make_scheduler(), LivenessCheck()
    process = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
    process.start()
    here = asdict(ProcessInfo.current()) | {"pid": process.pid, "started": process_start(process.pid)}
    scheduler.claim(here)
    assert not liveness.is_dead(scheduler.state().running[0])
    scheduler.renew(_trial(scheduler), here | {"started": "1"})
    assert liveness.is_dead(scheduler.state().running[0])
    scheduler.renew(_trial(scheduler), here)
    process.kill()
    # Killed and not yet waited for: a zombie.
    wait_until(lambda: liveness.is_dead(scheduler.state().running[0]))
    process.join()
    assert liveness.is_dead(scheduler.state().running[0])


def test_witness_takes_a_worker_elsewhere_for_dead_when_its_lease_is_not_renewed(make_scheduler, monkeypatch):
    scheduler, liveness, now_s = make_scheduler(), LivenessCheck(), [100.0]
    monkeypatch.setattr("armscan.sweeps.workers.heartbeat.time.monotonic", lambda: now_s[0])
    lease = {"worker": "a", "host": "elsewhere", "pid": 1, "started": "1", "beat": 0}
    scheduler.claim(lease)

    def found_dead_after(*waited_s):
        found = []
        for each_s in waited_s:
            now_s[0] += each_s
            found.append(liveness.is_dead(scheduler.state().running[0]))
        return found

    for beat in range(3):
        scheduler.renew(_trial(scheduler), lease | {"beat": beat})
        assert not any(found_dead_after(0, 10, 10, 10))
    assert found_dead_after(9, 10) == [False, True]
    scheduler.renew(_trial(scheduler), lease | {"beat": 3})
    # Nobody checked for long, because the storage was unavailable: then the lease could not be renewed, either.
    assert found_dead_after(0, 10, 500, 10, 10) == [False, False, False, False, True]


def test_keepers_of_many_trials_take_turns_in_looking_after_them(make_scheduler, monkeypatch):
    scheduler, now_s, looks = make_scheduler(), [100.0], []
    monkeypatch.setattr(lease_module.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(lease_module, "MAX_CHECKERS", 2)
    heartbeat = Heartbeat(scheduler, "a", should_leave=lambda: False, leave=lambda: None, on_death=pytest.fail)
    heartbeat.claim()
    alive = asdict(ProcessInfo.current())
    for _ in range(4):
        scheduler.claim(alive | {"worker": "b"})
    state = scheduler.state
    monkeypatch.setattr(scheduler, "state", lambda: looks.append(now_s[0]) or state())
    for _ in range(9):
        heartbeat._renew()
        now_s[0] += lease_module.HEARTBEAT_S
    # Five trials, of whose workers two may check per beat: each checks every second beat, 5 / 2 rounded down.
    assert [look_s - 100 for look_s in looks] == [0, 20, 40, 60, 80]
    own = [trial.user_attrs[LEASE]["beat"] for trial in state().running if trial.user_attrs[LEASE]["worker"] == "a"]
    assert own == [9]


def _trial(scheduler):
    return optuna.trial.Trial(scheduler.study, scheduler.state().running[0]._trial_id)


def test_lease_of_a_trial_says_who_runs_it(make_scheduler):
    scheduler = make_scheduler()
    scheduler.claim({"worker": "a", "beat": 0})
    assert scheduler.state().running[0].user_attrs[LEASE] == {"worker": "a", "beat": 0}


def test_requeued_trial_keeps_the_time_of_its_end_and_the_limit_stays_reached(make_scheduler):
    scheduler = make_scheduler(timeout_hours=1e-5)
    trial = scheduler.claim({"worker": "a"})
    time.sleep(0.05)
    scheduler.requeue(trial, {})
    reason = scheduler.limits.limit_reason(scheduler.state())
    assert reason == "study.timeout_hours, 1e-05, has been reached"
    spent_h = scheduler.state().busy_hours
    time.sleep(0.05)
    assert scheduler.state().busy_hours == spent_h


def test_time_before_a_trial_was_requeued_is_counted_once_another_worker_has_it(make_scheduler):
    scheduler = make_scheduler()
    trial = scheduler.claim({"worker": "a"})
    time.sleep(0.1)
    scheduler.requeue(trial, {})
    time.sleep(0.1)
    trial = scheduler.claim({"worker": "b"})
    time.sleep(0.1)
    finish(scheduler, trial)
    state = scheduler.state()
    (finished,) = state.finished
    assert state.busy_hours * 3600 == pytest.approx(seconds_of(finished), abs=1e-6)
    ((start_s, end_s),) = finished.user_attrs[EARLIER_SPANS]
    assert end_s - start_s >= 0.1
    assert seconds_of(finished) == pytest.approx(end_s - start_s + finished.duration.total_seconds(), abs=1e-5)


def test_attempts_that_a_retry_replaces_are_known_however_many(make_scheduler):
    scheduler = make_scheduler(max_retries=3)
    for _ in range(2):
        scheduler.claim({"worker": "a"})
        scheduler.reclaim(lambda _: True)
    retry = scheduler.claim({"worker": "a"})
    assert list(retried_by(retry, scheduler.study.get_trials(deepcopy=False))) == [1, 0]


@pytest.mark.parametrize(("hours", "spent_h"), [((1.5, 3.5), 1.0), ((5.0, 6.0), 1.0)], ids=["over", "after"])
def test_time_is_counted_rightly_when_clocks_are_put_forward(monkeypatch, hours, spent_h):
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    try:
        start, end = (datetime(2026, 3, 29) + timedelta(hours=each) for each in hours)
        trial = create_trial(value=1.0)
        trial.datetime_start, trial.datetime_complete = start, end
        assert StudyState.of([trial]).busy_hours == seconds_of(trial) / 3600 == spent_h
    finally:
        monkeypatch.undo()
        time.tzset()


def test_trial_whose_worker_died_before_its_second_heartbeat_took_no_negative_time():
    trial = create_trial(state=TrialState.RUNNING, user_attrs={LEASE: {BEAT_S: time.time() - 1.0}})
    trial.datetime_start = datetime.now()
    assert StudyState.of([trial]).busy_hours == 0.0
    trial.state, trial.datetime_complete = TrialState.FAIL, trial.datetime_start
    assert seconds_of(trial) >= 0.0


def test_trial_of_another_study_has_taken_no_time_here():
    assert seconds_of(create_trial(value=1.0, user_attrs={TAKEN_FROM: "a:0"})) is None


def test_failures_of_final_trainings_that_had_begun_to_train_do_not_end_them(make_scheduler):
    scheduler = make_scheduler(n_trials=100, max_failures=50)
    for number in range(4):
        trial = scheduler.claim({"worker": str(number)})
        # Final trainings report nothing.
        scheduler.renew(trial, {"worker": str(number), "env_steps": 500})
        fail(scheduler, trial, "diverged")
    assert scheduler.failure_reason(scheduler.state()) is None


def test_request_to_stop_a_trial_is_not_forgotten_between_two_checks(make_scheduler, monkeypatch):
    scheduler, now_s = make_scheduler(), [100.0]
    monkeypatch.setattr(lease_module.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(lease_module, "MAX_CHECKERS", 1)
    heartbeat = Heartbeat(scheduler, "a", should_leave=lambda: False, leave=lambda: None, on_death=pytest.fail)
    trial = heartbeat.claim()
    for _ in range(2):
        scheduler.claim(asdict(ProcessInfo.current()) | {"worker": "b"})
    trial.set_user_attr(STOP, "at 20:00 by x")
    for _ in range(2):
        # The first beat checks, the second does not.
        heartbeat._renew()
        now_s[0] += lease_module.HEARTBEAT_S
    with pytest.raises(optuna.TrialPruned):
        heartbeat.report_progress({})


def test_failures_that_two_starts_ignored_stay_ignored(make_scheduler):
    scheduler = make_scheduler(max_failures=0)
    for _ in range(2):
        fail(scheduler, scheduler.claim({}), "no luck")
        assert scheduler.reset_failures() == 1
        assert scheduler.failures(scheduler.state()) == []


def test_each_time_before_a_requeue_is_kept(make_scheduler):
    scheduler = make_scheduler()
    for _ in range(2):
        scheduler.requeue(scheduler.claim({}), {})
        assert scheduler.state().waiting[0].user_attrs[LEASE]["started"] == ""
    finish(scheduler, scheduler.claim({}))
    assert len(scheduler.state().finished[0].user_attrs[EARLIER_SPANS]) == 2


def test_requeue_by_a_worker_that_has_lost_the_trial_changes_nothing(make_scheduler):
    scheduler = make_scheduler()
    trial = scheduler.claim({"worker": "a"})
    scheduler.requeue(trial, {"worker": "a"})
    scheduler.claim({"worker": "b"})
    scheduler.requeue(trial, {"worker": "a"})
    (running,) = scheduler.state().running
    assert running.user_attrs[LEASE] == {"worker": "b"}


def test_failure_that_another_worker_told_is_not_told_again(make_scheduler):
    scheduler = make_scheduler(max_retries=0, max_failures=10)
    trial = scheduler.claim({"worker": "a"})
    outcome = TrialOutcome(trial, TrialState.FAIL, PendingWrites())
    scheduler.reclaim(lambda _: True)
    scheduler.claim({"worker": "a"}, outcome)
    assert not outcome.is_told


def test_claimed_trial_names_the_version_of_the_code_that_runs_it(make_scheduler):
    heartbeat = Heartbeat(make_scheduler(), "a", should_leave=lambda: False, leave=lambda: None, on_death=pytest.fail)
    assert heartbeat.claim().user_attrs[LEASE][CODE] == code_version()

"""The books of a study: exactly as many trials as asked for, whoever dies in between."""

import multiprocessing
import os
import random
import signal
import time

import optuna
import pytest
from optuna.trial import TrialState

from armscan.sweeps import lease as lease_module
from armscan.sweeps.lease import Keeper, Witness, process_start
from armscan.sweeps.tally import ATTEMPT, FAILURE, LEASE, RETRIED, RETRY_OF, Tally
from tests.sweeps.conftest import fail


def states(ledger):
    return [trial.state.name for trial in ledger.study.get_trials(deepcopy=False)]


def finish(ledger, trial, value=1.0):
    trial.report(value, 1)
    ledger.study.tell(trial, value)


def test_claim_gives_as_many_trials_as_are_wanted(make_ledger):
    ledger, other = make_ledger(n_trials=3), make_ledger(n_trials=3)
    trials = [ledger.claim({"worker": "a"}), other.claim({"worker": "b"}), ledger.claim({"worker": "a"})]
    assert [trial.number for trial in trials] == [0, 1, 2]
    assert other.claim({"worker": "b"}) is None
    assert other.end(other.tally()) is None
    for trial in trials:
        finish(ledger, trial)
    assert other.end(other.tally()) == "3 trials have finished"


def test_trial_that_is_handed_back_is_the_next_to_be_run_with_the_same_values(make_ledger):
    ledger, other = make_ledger(), make_ledger()
    trial = ledger.claim({"worker": "a"})
    value = trial.suggest_float("x", 0, 1)
    ledger.hand_back(trial, {})
    assert states(ledger) == ["WAITING"]
    again = other.claim({"worker": "b"})
    assert (again.number, again.suggest_float("x", 0, 1)) == (trial.number, value)


def test_failed_trial_is_replaced_until_too_many_have_failed(make_ledger):
    ledger = make_ledger(n_trials=2, max_failures=1)
    finish(ledger, ledger.claim({}))
    fail(ledger, ledger.claim({}), "no luck")
    assert ledger.end(ledger.tally()) is None
    fail(ledger, ledger.claim({}), "none again")
    reason = "2 trials have failed, and at most 1 may: trial 2: none again"
    assert ledger.end(ledger.tally()) == ledger.broken(ledger.tally()) == reason
    assert ledger.claim({}) is None


def test_study_whose_first_trials_all_fail_at_once_ends(make_ledger):
    ledger = make_ledger(n_trials=100, max_failures=50)
    for _ in range(3):
        assert ledger.broken(ledger.tally()) is None
        fail(ledger, ledger.claim({}), "agent.lr is -1")
    assert ledger.broken(ledger.tally()).endswith("before they reported anything: trial 0: agent.lr is -1")


def test_limits_of_time_and_environment_steps_end_a_study(make_ledger):
    ledger = make_ledger(env_steps=100)
    ledger.claim({"env_steps": 99})
    assert ledger.end(ledger.tally()) is None
    ledger.claim({"env_steps": 1})
    assert ledger.end(ledger.tally()) == "the 100 environment steps of study.env_steps are taken"
    assert make_ledger(hours=1.0).end(ledger.tally()) is None
    time.sleep(0.1)
    assert make_ledger(hours=1e-5).end(ledger.tally()) == "the 1e-05 hours of study.hours are over"


def test_trial_of_a_dead_worker_is_retried_once_with_its_values(make_ledger):
    ledger, other = make_ledger(), make_ledger()
    trial = ledger.claim({"worker": "a", "host": "there"})
    value = trial.suggest_float("x", 0, 1)
    assert other.reclaim(lambda _: False) == []
    assert [each.number for each in other.reclaim(lambda _: True)] == [0]
    assert ledger.reclaim(lambda _: True) == []
    assert states(ledger) == ["FAIL", "WAITING"]
    tally = ledger.tally()
    assert (len(tally.failed), len(tally.retried)) == (0, 1)
    assert tally.retried[0].user_attrs[FAILURE] == "its worker died: a on there"
    again = other.claim({"worker": "b"})
    assert again.user_attrs[RETRY_OF] == 0
    assert again.suggest_float("x", 0, 1) == value
    other.reclaim(lambda _: True)
    assert len(other.tally().failed) == 1
    assert RETRIED not in other.tally().failed[0].user_attrs
    # Whoever was taken for dead finds that it is not its own any more.
    with pytest.raises(optuna.exceptions.UpdateFinishedTrialError):
        trial.report(1.0, 1)
    ledger.hand_back(trial, {})
    ledger.renew(trial, {})
    assert states(ledger) == ["FAIL", "FAIL"]


def test_trial_whose_worker_died_while_it_took_it_is_reclaimed_at_once(make_ledger):
    ledger = make_ledger()
    ledger.study.ask()
    assert [trial.number for trial in ledger.reclaim(lambda _: False)] == [0]


def test_death_between_a_retry_and_the_failure_makes_no_second_retry(make_ledger, monkeypatch):
    ledger, other = make_ledger(), make_ledger()
    ledger.claim({"worker": "a"})
    monkeypatch.setattr(ledger, "_fail", lambda *_: (_ for _ in ()).throw(SystemExit))
    with pytest.raises(SystemExit):
        ledger.reclaim(lambda _: True)
    other.reclaim(lambda _: True)
    assert states(other) == ["FAIL", "WAITING"]


def reclaim_at(moment_s, make_ledger, n):
    ledger = make_ledger()
    time.sleep(max(0.0, moment_s - time.time()))
    for _ in range(n):
        ledger.reclaim(lambda trial: trial.number < 4)


def test_workers_that_notice_a_death_at_once_make_one_retry(make_ledger):
    ledger = make_ledger()
    for _ in range(4):
        ledger.claim({"worker": "a"})
    at_s = time.time() + 1.5
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=reclaim_at, args=(at_s, make_ledger, 3)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert states(ledger) == ["FAIL"] * 4 + ["WAITING"] * 4
    assert sorted(trial.user_attrs[RETRY_OF] for trial in ledger.tally().waiting) == [0, 1, 2, 3]
    assert {trial.user_attrs[ATTEMPT] for trial in ledger.tally().waiting} == {1}


def work(make_ledger, n_trials):
    ledger, witness, chance = make_ledger(n_trials=n_trials, max_retries=9), Witness(), random.Random(os.getpid())
    lease = {"host": os.uname().nodename, "pid": os.getpid(), "started": process_start(os.getpid())}
    while ledger.end(ledger.tally()) is None:
        ledger.reclaim(witness.is_dead)
        trial = ledger.claim(lease)
        if trial is None:
            time.sleep(0.01)
            continue
        trial.suggest_float("x", 0, 1)
        time.sleep(chance.uniform(0.0, 0.1))
        finish(ledger, trial)


def test_workers_killed_at_any_moment_lose_no_trial_and_make_none_too_many(make_ledger):
    n_trials, n_killed, context = 40, 0, multiprocessing.get_context("fork")
    ledger, chance = make_ledger(n_trials=n_trials), random.Random(0)

    def started():
        process = context.Process(target=work, args=(make_ledger, n_trials))
        process.start()
        return process

    workers = [started() for _ in range(3)]
    while ledger.end(ledger.tally()) is None:
        time.sleep(chance.uniform(0.05, 0.4))
        one = chance.randrange(3)
        if workers[one].is_alive():
            os.kill(workers[one].pid, signal.SIGKILL)
            n_killed += 1
            workers[one].join()
            workers[one] = started()
    for worker in workers:
        worker.join()
    tally = ledger.tally()
    assert n_killed > 2
    assert len(tally.finished) == n_trials
    assert not tally.failed
    assert not tally.running
    assert len({trial.params["x"] for trial in tally.finished}) == n_trials


def test_closed_ledger_runs_only_what_waits(make_ledger):
    ledger = make_ledger(n_trials=9, is_open=False)
    assert ledger.claim({}) is None
    ledger.study.enqueue_trial({"x": 1.0})
    trial = ledger.claim({})
    assert trial.suggest_float("x", 0, 2) == 1.0
    assert ledger.claim({}) is None
    finish(ledger, trial)
    assert ledger.end(ledger.tally()) == "1 trials have finished, 0 failed"


def test_tally_counts_the_time_in_which_anything_ran_once(make_ledger):
    ledger = make_ledger()
    trials = [ledger.claim({}) for _ in range(2)]
    time.sleep(0.2)
    for trial in trials:
        finish(ledger, trial)
    first, second = ledger.tally().finished
    spent_s = (second.datetime_complete - first.datetime_start).total_seconds()
    assert ledger.tally().busy_hours * 3600 == pytest.approx(spent_s, abs=0.05)
    assert {trial.state for trial in Tally.of(ledger.study.trials).all} == {TrialState.COMPLETE}


def test_witness_knows_a_process_that_is_gone_and_one_that_has_its_number(make_ledger):
    ledger, witness = make_ledger(), Witness()
    process = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
    process.start()
    here = {"host": os.uname().nodename, "pid": process.pid, "started": process_start(process.pid)}
    ledger.claim(here)
    assert not witness.is_dead(ledger.tally().running[0])
    ledger.renew(_trial(ledger), here | {"started": "1"})
    assert witness.is_dead(ledger.tally().running[0])
    ledger.renew(_trial(ledger), here)
    process.kill()
    # Killed, and not yet waited for: nothing but an exit code is left of it.
    time.sleep(0.2)
    assert witness.is_dead(ledger.tally().running[0])
    process.join()
    assert witness.is_dead(ledger.tally().running[0])


def test_witness_takes_a_worker_elsewhere_for_dead_when_its_lease_is_not_renewed(make_ledger, monkeypatch):
    ledger, witness, now_s = make_ledger(), Witness(), [100.0]
    monkeypatch.setattr("armscan.sweeps.lease.time.monotonic", lambda: now_s[0])
    lease = {"worker": "a", "host": "elsewhere", "pid": 1, "started": "1", "beat": 0}
    ledger.claim(lease)

    def found_dead_after(*waited_s):
        found = []
        for each_s in waited_s:
            now_s[0] += each_s
            found.append(witness.is_dead(ledger.tally().running[0]))
        return found

    for beat in range(3):
        ledger.renew(_trial(ledger), lease | {"beat": beat})
        assert not any(found_dead_after(0, 10, 10, 10))
    assert found_dead_after(9, 10) == [False, True]
    ledger.renew(_trial(ledger), lease | {"beat": 3})
    # Nobody looked for long, because the storage was away: then it could not be renewed, either.
    assert found_dead_after(0, 10, 500, 10, 10) == [False, False, False, False, True]


def test_keepers_of_many_trials_take_turns_in_looking_after_them(make_ledger, monkeypatch):
    ledger, now_s, looks = make_ledger(), [100.0], []
    monkeypatch.setattr(lease_module.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(lease_module, "LOOKING_AT_ONCE", 2)
    keeper = Keeper(ledger, "a", is_told_to_leave=lambda: False, leave=lambda: None, on_death=pytest.fail)
    keeper.claim()
    alive = {"host": os.uname().nodename, "pid": os.getpid(), "started": process_start(os.getpid())}
    for _ in range(4):
        ledger.claim(alive | {"worker": "b"})
    tally = ledger.tally
    monkeypatch.setattr(ledger, "tally", lambda: looks.append(now_s[0]) or tally())
    for _ in range(9):
        keeper._give_sign()
        now_s[0] += lease_module.BEAT_S
    # Five trials, of whose workers two may look in a beat: each after two beats, as two and a half cannot be.
    assert [look_s - 100 for look_s in looks] == [0, 20, 40, 60, 80]
    own = [trial.user_attrs[LEASE]["beat"] for trial in tally().running if trial.user_attrs[LEASE]["worker"] == "a"]
    assert own == [9]


def _trial(ledger):
    return optuna.trial.Trial(ledger.study, ledger.tally().running[0]._trial_id)


def test_lease_of_a_trial_says_who_runs_it(make_ledger):
    ledger = make_ledger()
    ledger.claim({"worker": "a", "beat": 0})
    assert ledger.tally().running[0].user_attrs[LEASE] == {"worker": "a", "beat": 0}

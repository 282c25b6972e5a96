"""Storages that are unavailable for a while: nothing is lost, nothing is done twice, and nobody waits for ever."""

import multiprocessing
import os
import random
import sqlite3
import threading
import time
from dataclasses import asdict
from functools import partial

import optuna
import pytest
from optuna.trial import TrialState
from sqlalchemy import create_engine, text
from sqlalchemy.exc import SQLAlchemyError

from armscan.errors import StorageUnavailableError
from armscan.sweeps.results import progress as screen
from armscan.sweeps.scheduling.claim import PendingWrites, TrialOutcome
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.storage.attribute_names import LEASE, RETRY_OF
from armscan.sweeps.storage.database import unavailable_reason
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.workers import heartbeat as lease
from armscan.sweeps.workers.heartbeat import Heartbeat, LivenessCheck
from armscan.utils import retry
from armscan.utils.processes import ProcessInfo
from tests.support.waiting import HANG_S, wait_until
from tests.sweeps.conftest import scheduler_at
from tests.sweeps.scheduling.test_scheduler import states


@pytest.fixture
def open_scheduler(postgres):
    return partial(scheduler_at, postgres.make_database())


@pytest.fixture(params=[True, False], ids=["done", "undone"])
def lose_commit(request, monkeypatch):
    """Return a function that loses the connection during the next commit of a change, after or before it is done."""

    def lose(scheduler, meanwhile=lambda: None):
        import psycopg

        dialect = scheduler.storage.optuna._backend.engine.dialect
        commit = dialect.do_commit

        def lost(connection):
            if connection.dbapi_connection.execute("SELECT pg_current_xact_id_if_assigned()").fetchone() == (None,):
                return commit(connection)
            monkeypatch.setattr(dialect, "do_commit", commit)
            if request.param:
                commit(connection)
            connection.dbapi_connection.close()
            meanwhile()
            raise psycopg.OperationalError("the connection is lost")

        monkeypatch.setattr(dialect, "do_commit", lost)

    return lose


def complete(trial, value):
    """Return the outcome of a trial, which its worker tells with its next claim."""
    return TrialOutcome(trial, TrialState.COMPLETE, PendingWrites(), values=[value])


def test_claim_whose_answer_is_lost_takes_one_trial(open_scheduler, lose_commit):
    scheduler = open_scheduler()
    lose_commit(scheduler)
    trial = scheduler.claim({"worker": "a"})
    assert (states(scheduler), trial.number) == (["RUNNING"], 0)
    assert open_scheduler().state().running[0].user_attrs[LEASE] == {"worker": "a"}
    assert 0 <= trial.suggest_float("x", 0, 1) <= 1
    scheduler.study.tell(trial, 1.0)
    assert states(scheduler) == ["COMPLETE"]


def test_claim_of_a_waiting_trial_whose_answer_is_lost_takes_that(open_scheduler, lose_commit):
    scheduler = open_scheduler()
    scheduler.requeue(scheduler.claim({"worker": "a"}), {"worker": "a"})
    lose_commit(scheduler)
    assert scheduler.claim({"worker": "a"}).number == 0
    assert states(scheduler) == ["RUNNING"]


def test_trial_is_told_once_where_the_answer_is_lost(open_scheduler, lose_commit, capsys):
    scheduler = open_scheduler()
    outcome = complete(scheduler.claim({}), 3.0)
    lose_commit(scheduler)
    scheduler.claim({}, outcome)
    assert outcome.is_told
    assert [each.value for each in open_scheduler().state().finished] == [3.0]
    said = [line.partition("  ")[2] for line in capsys.readouterr().out.splitlines()]
    assert said == ["the storage is unavailable (the connection is lost): waiting", "the storage is back"]


def test_trial_that_was_failed_by_another_meanwhile_is_not_told(open_scheduler, lose_commit):
    scheduler, other = open_scheduler(n_trials=1), open_scheduler(n_trials=1)
    outcome = complete(scheduler.claim({}), 1.0)
    lose_commit(scheduler, meanwhile=lambda: other.reclaim(lambda _: True))
    scheduler.claim({}, outcome)
    assert states(other) == (["COMPLETE"] if outcome.is_told else ["FAIL", "RUNNING"])


def test_trial_that_is_taken_up_by_another_while_it_is_handed_back_stays_theirs(open_scheduler, lose_commit):
    scheduler, other = open_scheduler(n_trials=1), open_scheduler(n_trials=1)
    trial, taken = scheduler.claim({"worker": "a"}), []
    lose_commit(scheduler, meanwhile=lambda: taken.append(other.claim({"worker": "b"})))
    scheduler.requeue(trial, {"worker": "a"})
    if taken == [None]:
        taken = [other.claim({"worker": "b"})]
    assert states(other) == ["RUNNING"]
    assert other.state().running[0].user_attrs[LEASE] == {"worker": "b"}


def test_death_is_told_and_retried_once_where_the_answer_is_lost(open_scheduler, lose_commit):
    scheduler = open_scheduler()
    scheduler.claim({"worker": "a"})
    lose_commit(scheduler)
    assert [trial.number for trial in scheduler.reclaim(lambda _: True)] == [0]
    assert states(scheduler) == ["FAIL", "WAITING"]
    assert scheduler.state().waiting[0].user_attrs[RETRY_OF] == 0


def test_claim_in_the_middle_of_which_the_server_restarts_holds_the_lock_again(open_scheduler, postgres, monkeypatch):
    scheduler, other = open_scheduler(n_trials=1), open_scheduler(n_trials=1)
    ask, asked = scheduler.study.ask, []

    def ask_and_lose():
        asked.append(ask())
        if len(asked) == 1:
            postgres.restart(at_once=True)
            # The lock went with the connection: somebody else has it now.
            assert other.claim({"worker": "b"}).number == 0
        return asked[-1]

    monkeypatch.setattr(scheduler.study, "ask", ask_and_lose)
    assert scheduler.claim({"worker": "a"}) is None
    assert states(scheduler) == states(other) == ["RUNNING"]
    assert other.state().running[0].user_attrs[LEASE] == {"worker": "b"}


def test_what_was_decided_where_something_went_wrong_is_not_there(open_scheduler):
    scheduler = open_scheduler()

    def decide():
        for _ in range(2):
            scheduler.study.ask()
        raise ValueError("something went wrong")

    assert scheduler.storage.exclusive(scheduler.state).all == ()
    with pytest.raises(ValueError, match="something went wrong"):
        scheduler.storage.exclusive(decide)
    assert scheduler.state().all == open_scheduler().state().all == ()
    assert scheduler.storage.exclusive(scheduler.state).all == ()


def work(open_scheduler, n_trials):
    scheduler, liveness, chance = open_scheduler(n_trials=n_trials), LivenessCheck(), random.Random(os.getpid())
    holder = asdict(ProcessInfo.current())
    outcome = None
    while outcome is not None or scheduler.end_reason(scheduler.state()) is None:
        scheduler.reclaim(liveness.is_dead)
        trial = scheduler.claim(holder, outcome)
        outcome = None
        if trial is None:
            time.sleep(0.01)
            continue
        trial.suggest_float("x", 0, 1)
        time.sleep(chance.uniform(0.0, 0.1))
        trial.report(1.0, 1)
        outcome = complete(trial, 1.0)


def test_workers_lose_no_trial_and_make_none_too_many_while_the_server_restarts(open_scheduler, postgres):
    n_trials, context = 60, multiprocessing.get_context("fork")
    scheduler = open_scheduler(n_trials=n_trials)
    workers = [context.Process(target=work, args=(open_scheduler, n_trials)) for _ in range(3)]
    for worker in workers:
        worker.start()
    for n_done, is_crash in ((10, True), (35, False)):
        wait_until(lambda n_done=n_done: len(scheduler.state().finished) >= n_done)
        postgres.restart(away_s=1.0, at_once=is_crash)
    for worker in workers:
        worker.join(HANG_S)
    state = scheduler.state()
    assert [worker.exitcode for worker in workers] == [0, 0, 0]
    assert len(state.finished) == n_trials
    assert state.all == state.finished
    assert len({trial.params["x"] for trial in state.finished}) == n_trials


@pytest.mark.full
def test_sqlite_file_that_is_locked_for_long_is_waited_for(tmp_path, capsys):
    storage = open_storage(f"sqlite:///{tmp_path}/a.db")
    study = optuna.create_study(storage=storage.optuna)
    scheduler = TrialScheduler(study, storage, Limits(n_trials=1))
    locked = sqlite3.connect(tmp_path / "a.db", isolation_level=None, check_same_thread=False)
    locked.execute("BEGIN EXCLUSIVE")
    threading.Timer(10.5, locked.close).start()
    trial = scheduler.claim({})
    study.tell(trial, 1.0)
    assert states(scheduler) == ["COMPLETE"]
    assert capsys.readouterr().out.count("(database is locked): waiting") == 1


def test_retry_policy_ends_in_one_line_that_does_not_show_the_password(open_scheduler, postgres, monkeypatch, capsys):
    monkeypatch.setattr(retry, "RETRY_S", 5.0)
    scheduler = open_scheduler()
    trial = scheduler.claim({})
    postgres.stop()
    try:
        with pytest.raises(StorageUnavailableError) as given_up:
            scheduler.claim({})
        began_s = time.monotonic()
        with pytest.raises(StorageUnavailableError):
            scheduler.study.tell(trial, 1.0)
        # It is not waited for again.
        assert time.monotonic() - began_s < 5.0
        line = f"study.storage is 'postgresql://armscan@127.0.0.1:{postgres.port}/"
        assert str(given_up.value).startswith(line)
        assert "but it has been unavailable for 5 s: connection failed" in str(given_up.value)
        assert capsys.readouterr().out.count("\n") == 1
    finally:
        postgres.start()


def test_thread_without_retry_is_told_at_once(open_scheduler, postgres, capsys):
    scheduler = open_scheduler()
    postgres.stop()
    try:
        with retry.no_retry(), pytest.raises(StorageUnavailableError, match="but it is unavailable: connection failed"):
            scheduler.state()
    finally:
        postgres.start()
    assert capsys.readouterr().out == ""
    with retry.no_retry():
        assert scheduler.state().all == ()


def test_worker_that_is_opened_while_the_server_is_unavailable_waits_for_it(postgres):
    uri = postgres.make_database()
    postgres.stop()
    threading.Timer(1.0, postgres.start).start()
    assert optuna.get_all_study_names(open_storage(uri, retry=True).optuna) == []


def test_worker_told_to_leave_while_the_storage_is_unavailable_leaves_soon(open_scheduler, postgres, monkeypatch):
    monkeypatch.setattr(lease, "REQUEUE_TIMEOUT_S", 1.0)
    scheduler, told, left = open_scheduler(), threading.Event(), threading.Event()
    heartbeat = Heartbeat(scheduler, "a", should_leave=told.is_set, leave=left.set, on_death=pytest.fail)
    with heartbeat.running():
        heartbeat.claim()
        postgres.stop()
        try:
            told.set()
            # Long before it would give up on the storage.
            assert left.wait(60.0)
        finally:
            postgres.start()
            told.clear()


def test_screen_says_once_that_the_storage_is_away_and_shows_what_is_new_when_it_is_back(monkeypatch, capsys):
    monkeypatch.setattr(screen, "REFRESH_S", 0.0)
    stopped, is_unavailable = threading.Event(), [True, True, False, False]

    def show():
        if len(is_unavailable) == 2:
            stopped.set()
        if is_unavailable.pop(0):
            raise StorageUnavailableError("it is unavailable")
        print("trial 3 done")

    screen.repeat(show, stopped)
    assert capsys.readouterr().out.splitlines() == ["it is unavailable", "trial 3 done", "trial 3 done"]


@pytest.mark.parametrize(("statement", "is_waited_for"), [("SELECT * FROM nowhere", False), ("DELETE FROM a", True)])
def test_only_what_passes_is_waited_for(tmp_path, statement, is_waited_for):
    file = tmp_path / "a.db"
    locked = sqlite3.connect(file, isolation_level=None)
    locked.execute("CREATE TABLE a (b)")
    locked.execute("BEGIN EXCLUSIVE" if is_waited_for else "BEGIN")
    engine = create_engine(f"sqlite:///{file}", connect_args={"timeout": 0})
    with pytest.raises(SQLAlchemyError) as raised, engine.begin() as connection:
        connection.execute(text(statement))
    locked.close()
    assert (unavailable_reason(raised.value) is not None) is is_waited_for

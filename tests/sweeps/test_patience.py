"""Storages that are away for a while: nothing is lost, nothing is done twice, and nobody waits for ever."""

import contextlib
import multiprocessing
import os
import random
import sqlite3
import threading
import time

import optuna
import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.exc import SQLAlchemyError

from armscan import patience
from armscan.errors import StorageAwayError
from armscan.sweeps import lease, screen
from armscan.sweeps.away import is_away
from armscan.sweeps.lease import Keeper, Witness, process_start
from armscan.sweeps.ledger import Ledger
from armscan.sweeps.limits import Limits
from armscan.sweeps.storage import open_storage
from armscan.sweeps.tally import LEASE, RETRY_OF


@pytest.fixture
def open_ledger(postgres):
    uri = postgres.make_database()

    def opened(**limits):
        storage = open_storage(uri)
        study = optuna.create_study(study_name="a", storage=storage.optuna, load_if_exists=True)
        return Ledger(study, storage, Limits(**{"n_trials": 5} | limits))

    return opened


@pytest.fixture(params=[True, False], ids=["done", "undone"])
def lose_commit(request, monkeypatch):
    """Loses the connection while the next transaction that changes anything is committed, once it is done or before."""

    def lose(ledger, meanwhile=lambda: None):
        import psycopg

        dialect = ledger._storage.optuna._rdb.engine.dialect
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


def states(ledger):
    return [trial.state.name for trial in ledger.study.get_trials(deepcopy=False)]


def test_claim_whose_answer_is_lost_takes_one_trial(open_ledger, lose_commit):
    ledger = open_ledger()
    lose_commit(ledger)
    trial = ledger.claim({"worker": "a"})
    assert (states(ledger), trial.number) == (["RUNNING"], 0)
    assert open_ledger().tally().running[0].user_attrs[LEASE] == {"worker": "a"}
    assert 0 <= trial.suggest_float("x", 0, 1) <= 1
    ledger.study.tell(trial, 1.0)
    assert states(ledger) == ["COMPLETE"]


def test_claim_of_a_waiting_trial_whose_answer_is_lost_takes_that(open_ledger, lose_commit):
    ledger = open_ledger()
    ledger.hand_back(ledger.claim({"worker": "a"}), {"worker": "a"})
    lose_commit(ledger)
    assert ledger.claim({"worker": "a"}).number == 0
    assert states(ledger) == ["RUNNING"]


def test_trial_is_told_once_where_the_answer_is_lost(open_ledger, lose_commit, capsys):
    ledger = open_ledger()
    trial = ledger.claim({})
    lose_commit(ledger)
    ledger.study.tell(trial, 3.0)
    assert [each.value for each in open_ledger().tally().finished] == [3.0]
    said = [line.partition("  ")[2] for line in capsys.readouterr().out.splitlines()]
    assert said == ["the storage is away (the connection is lost): waiting", "the storage is back"]


def test_trial_that_was_failed_by_another_meanwhile_is_not_told(open_ledger, lose_commit):
    ledger, other = open_ledger(), open_ledger()
    trial, is_told = ledger.claim({}), False
    lose_commit(ledger, meanwhile=lambda: other.reclaim(lambda _: True))
    with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):
        ledger.study.tell(trial, 1.0)
        is_told = True
    assert states(other) == (["COMPLETE"] if is_told else ["FAIL", "WAITING"])


def test_trial_that_is_taken_up_by_another_while_it_is_handed_back_stays_theirs(open_ledger, lose_commit):
    ledger, other = open_ledger(n_trials=1), open_ledger(n_trials=1)
    trial, taken = ledger.claim({"worker": "a"}), []
    lose_commit(ledger, meanwhile=lambda: taken.append(other.claim({"worker": "b"})))
    ledger.hand_back(trial, {"worker": "a"})
    if taken == [None]:
        taken = [other.claim({"worker": "b"})]
    assert states(other) == ["RUNNING"]
    assert other.tally().running[0].user_attrs[LEASE] == {"worker": "b"}


def test_death_is_told_and_retried_once_where_the_answer_is_lost(open_ledger, lose_commit):
    ledger = open_ledger()
    ledger.claim({"worker": "a"})
    lose_commit(ledger)
    assert [trial.number for trial in ledger.reclaim(lambda _: True)] == [0]
    assert states(ledger) == ["FAIL", "WAITING"]
    assert ledger.tally().waiting[0].user_attrs[RETRY_OF] == 0


def test_claim_in_the_middle_of_which_the_server_restarts_holds_the_lock_again(open_ledger, postgres, monkeypatch):
    ledger, other = open_ledger(n_trials=1), open_ledger(n_trials=1)
    ask, asked = ledger.study.ask, []

    def ask_and_lose():
        asked.append(ask())
        if len(asked) == 1:
            postgres.restart(at_once=True)
            # The lock went with the connection: somebody else has it now.
            assert other.claim({"worker": "b"}).number == 0
        return asked[-1]

    monkeypatch.setattr(ledger.study, "ask", ask_and_lose)
    assert ledger.claim({"worker": "a"}) is None
    assert states(ledger) == states(other) == ["RUNNING"]
    assert other.tally().running[0].user_attrs[LEASE] == {"worker": "b"}


def test_what_was_decided_where_something_went_wrong_is_not_there(open_ledger):
    ledger = open_ledger()

    def decide():
        for _ in range(2):
            ledger.study.ask()
        raise ValueError("something went wrong")

    assert ledger._storage.alone(ledger.tally).all == ()
    with pytest.raises(ValueError, match="something went wrong"):
        ledger._storage.alone(decide)
    assert ledger.tally().all == open_ledger().tally().all == ()
    assert ledger._storage.alone(ledger.tally).all == ()


def work(open_ledger, n_trials):
    ledger, witness, chance = open_ledger(n_trials=n_trials), Witness(), random.Random(os.getpid())
    holder = {"host": os.uname().nodename, "pid": os.getpid(), "started": process_start(os.getpid())}
    while ledger.end(ledger.tally()) is None:
        ledger.reclaim(witness.is_dead)
        trial = ledger.claim(holder)
        if trial is None:
            time.sleep(0.01)
            continue
        trial.suggest_float("x", 0, 1)
        time.sleep(chance.uniform(0.0, 0.1))
        trial.report(1.0, 1)
        ledger.study.tell(trial, 1.0)


def test_workers_lose_no_trial_and_make_none_too_many_while_the_server_restarts(open_ledger, postgres):
    n_trials, context = 60, multiprocessing.get_context("fork")
    ledger = open_ledger(n_trials=n_trials)
    workers = [context.Process(target=work, args=(open_ledger, n_trials)) for _ in range(3)]
    for worker in workers:
        worker.start()
    for n_done, is_crash in ((10, True), (35, False)):
        while len(ledger.tally().finished) < n_done:
            time.sleep(0.05)
        postgres.restart(away_s=1.0, at_once=is_crash)
    for worker in workers:
        worker.join(60)
    tally = ledger.tally()
    assert [worker.exitcode for worker in workers] == [0, 0, 0]
    assert len(tally.finished) == n_trials
    assert tally.all == tally.finished
    assert len({trial.params["x"] for trial in tally.finished}) == n_trials


def test_sqlite_file_that_is_locked_for_long_is_waited_for(tmp_path, capsys):
    storage = open_storage(f"sqlite:///{tmp_path}/a.db")
    study = optuna.create_study(storage=storage.optuna)
    ledger = Ledger(study, storage, Limits(n_trials=1))
    locked = sqlite3.connect(tmp_path / "a.db", isolation_level=None, check_same_thread=False)
    locked.execute("BEGIN EXCLUSIVE")
    threading.Timer(10.5, locked.close).start()
    trial = ledger.claim({})
    study.tell(trial, 1.0)
    assert states(ledger) == ["COMPLETE"]
    assert capsys.readouterr().out.count("(database is locked): waiting") == 1


def test_patience_ends_in_one_line_that_does_not_show_the_password(open_ledger, postgres, monkeypatch, capsys):
    monkeypatch.setattr(patience, "PATIENCE_S", 1.2)
    ledger = open_ledger()
    trial = ledger.claim({})
    postgres.stop()
    try:
        with pytest.raises(StorageAwayError) as given_up:
            ledger.claim({})
        began_s = time.monotonic()
        with pytest.raises(StorageAwayError):
            ledger.study.tell(trial, 1.0)
        assert time.monotonic() - began_s < 1.0
        line = f"study.storage is 'postgresql://armscan@127.0.0.1:{postgres.port}/"
        assert str(given_up.value).startswith(line)
        assert "but it has been away for 1.2 s: connection failed" in str(given_up.value)
        assert capsys.readouterr().out.count("\n") == 1
    finally:
        postgres.start()


def test_impatient_thread_is_told_at_once(open_ledger, postgres, capsys):
    ledger = open_ledger()
    postgres.stop()
    try:
        with patience.impatient(), pytest.raises(StorageAwayError, match="but it is away: connection failed"):
            ledger.tally()
    finally:
        postgres.start()
    assert capsys.readouterr().out == ""
    with patience.impatient():
        assert ledger.tally().all == ()


def test_worker_that_is_opened_while_the_server_is_away_waits_for_it(postgres):
    uri = postgres.make_database()
    postgres.stop()
    threading.Timer(1.0, postgres.start).start()
    assert optuna.get_all_study_names(open_storage(uri, is_patient=True).optuna) == []


def test_worker_that_is_told_to_leave_while_the_storage_is_away_leaves_soon(open_ledger, postgres, monkeypatch):
    monkeypatch.setattr(lease, "HAND_BACK_S", 1.0)
    ledger, told, left = open_ledger(), threading.Event(), threading.Event()
    keeper = Keeper(ledger, "a", is_told_to_leave=told.is_set, leave=left.set, on_death=pytest.fail)
    with keeper.at_work():
        keeper.claim()
        postgres.stop()
        try:
            told.set()
            assert left.wait(3.0)
        finally:
            postgres.start()
            told.clear()


def test_screen_says_once_that_the_storage_is_away_and_shows_what_is_new_when_it_is_back(monkeypatch, capsys):
    monkeypatch.setattr(screen, "REFRESH_S", 0.0)
    # Of a screen, what shows again and again.
    shown = screen.Screen.__new__(screen.Screen)
    shown._stopped, is_away = threading.Event(), [True, True, False, False]

    def show():
        if len(is_away) == 2:
            shown._stopped.set()
        if is_away.pop(0):
            raise StorageAwayError("it is away")
        print("trial 3 done")

    shown._repeat(show)
    assert capsys.readouterr().out.splitlines() == ["it is away", "trial 3 done", "trial 3 done"]


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
    assert is_away(raised.value) is is_waited_for

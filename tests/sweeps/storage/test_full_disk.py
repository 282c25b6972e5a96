"""Disks that are full under the storage of a study: it waits, and no trial is lost or run twice."""

import multiprocessing
import sqlite3
from functools import partial

import pytest
from optuna.exceptions import StorageInternalError
from optuna.trial import TrialState
from sqlalchemy.exc import OperationalError

from armscan.errors import StorageUnavailableError
from armscan.sweeps.storage.database import unavailable_reason
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.study import make_study
from armscan.utils import retry
from tests.support.waiting import HANG_S, wait_until
from tests.sweeps.conftest import scheduler_at
from tests.sweeps.scheduling.test_scheduler import work
from tests.sweeps.study.test_study import settings

pytestmark = pytest.mark.full
N_TRIALS = 40
FULL = ("No space left on device", "database or disk is full")


@pytest.fixture(params=["{}/a.journal", "sqlite:///{}/a.db"], ids=["journal", "sqlite"])
def uri(request, disk):
    return request.param.format(disk.folder)


def test_study_waits_while_its_disk_is_full_and_loses_no_trial(disk, uri, capfd):
    make_scheduler = partial(scheduler_at, uri)
    scheduler, context = make_scheduler(n_trials=N_TRIALS), multiprocessing.get_context("fork")
    workers = [context.Process(target=work, args=(make_scheduler, N_TRIALS)) for _ in range(2)]
    for worker in workers:
        worker.start()
    wait_until(lambda: len(scheduler.state().finished) >= 10)
    told = []

    def is_waiting():
        # At least one worker waits: it may hold the lock that the other waits for.
        told.extend(capfd.readouterr())
        return any(f"the storage is unavailable ({reason}): waiting" in "".join(told) for reason in FULL)

    disk.fill()
    wait_until(is_waiting)
    disk.empty()
    for worker in workers:
        worker.join(HANG_S)
    assert [worker.exitcode for worker in workers] == [0, 0], "".join([*told, *capfd.readouterr()])
    trials = make_scheduler(n_trials=N_TRIALS).study.trials
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * N_TRIALS
    assert len({trial.params["x"] for trial in trials}) == N_TRIALS


def test_study_on_a_disk_that_stays_full_is_answered_in_one_line(disk, uri, monkeypatch):
    make_study(open_storage(uri), settings(storage=uri), {})
    monkeypatch.setattr(retry, "RETRY_S", 0.5)
    storage = open_storage(uri)
    study = make_study(storage, settings(storage=uri), {})
    disk.fill()
    with pytest.raises(StorageUnavailableError) as given_up:
        study.set_user_attr("note", "x" * 2**20)
    line = str(given_up.value)
    assert line.startswith(f"study.storage is '{uri}', but it has been unavailable for 0.5 s: ")
    assert line.endswith(FULL)
    disk.empty()
    assert make_study(open_storage(uri), settings(storage=uri), {}).trials == []


def test_savepoint_of_a_transaction_that_sqlite_has_rolled_back_is_not_the_reason():
    full = sqlite3.OperationalError("database or disk is full")
    full.sqlite_errorname = "SQLITE_FULL"
    lost = sqlite3.OperationalError("no such savepoint: sa_savepoint_1")
    lost.sqlite_errorname = "SQLITE_ERROR"
    lost.__context__ = OperationalError("INSERT", None, full)
    error, outer = OperationalError("ROLLBACK TO SAVEPOINT", None, lost), StorageInternalError("during the commit")
    error.__cause__, outer.__cause__ = lost, error
    assert unavailable_reason(outer) == "database or disk is full"
    lost.__context__ = None
    assert unavailable_reason(outer) is None

"""Runs whose process was killed: the next process ends them, if the process was of this machine and is gone."""

import contextlib
import json
import multiprocessing
import os
import shutil
import signal
from dataclasses import asdict

import pytest
from mlflow import MlflowClient

from armscan.tracking import TrackedRun, open_existing_store, open_store, sync
from armscan.tracking.outbox import Outbox, file_of, now_ms
from armscan.tracking.pending_runs import PENDING_FOLDER, pending_runs
from armscan.tracking.sync import FOLDER_REMOVED, PROCESS_DIED, _upload_pending
from armscan.utils.processes import ProcessInfo
from tests.support.waiting import HANG_S

pytestmark = pytest.mark.full
# Forks have imported the package, which takes seconds.
FORKSERVER = multiprocessing.get_context("forkserver")
FORKSERVER.set_forkserver_preload([__name__, "mlflow.store.tracking.sqlalchemy_store"])


@pytest.fixture
def uri(database, tmp_path, monkeypatch):
    monkeypatch.setenv("ARMSCAN_CACHE", str(tmp_path / "cache"))
    return database


def start_and_die(uri, folder, cache, started):
    """Start a run in the folder `run`, and be killed while it trains."""
    os.environ["ARMSCAN_CACHE"] = str(cache)
    store, experiment = open_store(uri, experiment="test", artifacts=str(folder), wait_s=60.0)
    tracked = TrackedRun.start(store, experiment, name="n", config={"seed": 3}, tags={}, folder=folder / "run")
    tracked._uploader.finish(60.0)
    started.send(tracked.run_id)
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture
def run_id(uri, tmp_path):
    """Return the ID of a run in the folder `run` that was killed while it trained."""
    receiver, sender = FORKSERVER.Pipe(duplex=False)
    process = FORKSERVER.Process(target=start_and_die, args=(uri, tmp_path, tmp_path / "cache", sender))
    process.start()
    assert receiver.poll(HANG_S)
    run_id = receiver.recv()
    process.join()
    assert pending_runs().keys() == {run_id}
    assert ending_of(uri, run_id) == ("RUNNING", None)
    return run_id


def ending_of(uri, run_id):
    run = MlflowClient(uri).get_run(run_id)
    return run.info.status, run.data.tags.get("failure")


@pytest.mark.parametrize("is_removed", [False, True])
@pytest.mark.parametrize("who", ["a start", "runs sync"])
def test_run_that_was_killed_is_ended_by_the_next_process(uri, run_id, tmp_path, who, is_removed):
    if is_removed:
        shutil.rmtree(tmp_path / "run")
    if who == "a start":
        _upload_pending(open_existing_store(uri))
        assert pending_runs() == {}
    else:
        assert not any(upload.left for upload in sync(tmp_path, open_existing_store))
    assert ending_of(uri, run_id) == ("FAILED", FOLDER_REMOVED if is_removed else PROCESS_DIED)


@pytest.mark.parametrize("who", ["a start", "runs sync"])
def test_run_that_another_process_tracks_beside_the_dead_one_is_not_ended(uri, run_id, tmp_path, who):
    def look():
        if who == "a start":
            _upload_pending(open_existing_store(uri))
        else:
            sync(tmp_path, open_existing_store)
        return ending_of(uri, run_id)

    shutil.copytree(tmp_path / "run", tmp_path / "beside")
    with contextlib.closing(Outbox(file_of(tmp_path / "beside", run_id))):
        assert look() == ("RUNNING", None)
    assert look() == ("FAILED", PROCESS_DIED)


def test_end_that_the_store_has_already_stays(uri, run_id, tmp_path):
    store = open_existing_store(uri)
    store.set_tag(run_id, "failure", "interrupted")
    store.set_terminated(run_id, "KILLED")
    ended_ms = store.get_run(run_id).info.end_time
    other, _ = open_store(f"sqlite:///{tmp_path}/other.db", experiment="a", artifacts=str(tmp_path), wait_s=1.0)
    for each in (other, store):
        _upload_pending(each)
    assert not any(upload.left for upload in sync(tmp_path, open_existing_store))
    assert ending_of(uri, run_id) == ("KILLED", "interrupted")
    assert store.get_run(run_id).info.end_time == ended_ms


def test_run_whose_process_died_ended_with_its_last_metric(uri, run_id, tmp_path):
    with contextlib.closing(Outbox(file_of(tmp_path / "run", run_id))) as outbox:
        outbox.add(status=("RUNNING", 1_000))
        outbox.add(metrics=[["a", 0.5, 3_000, 1], ["a", 0.5, 9_000, 2]])
    sync(tmp_path, open_existing_store)
    assert ending_of(uri, run_id) == ("FAILED", PROCESS_DIED)
    assert open_existing_store(uri).get_run(run_id).info.end_time == 9_000


def test_end_before_the_run_was_resumed_is_not_its_end(uri, run_id, tmp_path):
    store = open_existing_store(uri)
    store.set_tag(run_id, "failure", "interrupted")
    store.set_terminated(run_id, "KILLED")
    with contextlib.closing(Outbox(file_of(tmp_path / "run", run_id))) as outbox:
        outbox.add(status=("RUNNING", now_ms() + 1000))
    assert not any(upload.left for upload in sync(tmp_path, open_existing_store))
    assert ending_of(uri, run_id) == ("FAILED", PROCESS_DIED)


@pytest.mark.parametrize("is_removed", [False, True])
@pytest.mark.parametrize(
    "changed", [{"host": "elsewhere"}, {"boot": "another"}, {"pid_namespace": "another"}, asdict(ProcessInfo.current())]
)
def test_run_of_another_machine_or_of_a_living_process_is_not_ended(uri, run_id, tmp_path, changed, is_removed):
    file = tmp_path / "cache" / PENDING_FOLDER / run_id
    record = json.loads(file.read_text())
    file.write_text(json.dumps(record | {"process": record["process"] | changed}))
    if is_removed:
        shutil.rmtree(tmp_path / "run")
    sync(tmp_path, open_existing_store)
    _upload_pending(open_existing_store(uri))
    assert ending_of(uri, run_id) == ("RUNNING", None)


@pytest.mark.parametrize("place", ["link", "sub/.."])
def test_folder_may_be_named_in_any_way(uri, run_id, tmp_path, place):
    (tmp_path / "link").symlink_to(tmp_path)
    (tmp_path / "sub").mkdir()
    assert not any(upload.left for upload in sync(tmp_path / place, open_existing_store))
    assert ending_of(uri, run_id) == ("FAILED", PROCESS_DIED)

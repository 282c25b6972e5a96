"""Tracking stores that are unavailable for a while, or for good: training goes on, and nothing is lost."""

import os
import shutil
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import pytest
import requests
import sqlalchemy
from mlflow import MlflowClient

from armscan.cli.main import main
from armscan.errors import TrackingError, TrackingUnavailableError
from armscan.tracking import TrackedRun, fail_dead_runs, open_store, record_end, sync, upload_pending, uploader
from armscan.tracking.outbox import file_of
from armscan.tracking.pending_runs import pending_runs
from armscan.tracking.tracking_store import reason_in, unavailable_reason
from armscan.utils.files import cache_folder
from tests.support.disks import small_disk
from tests.support.mlflow_server import mlflow_server
from tests.support.waiting import HANG_S, wait_until

N_EPOCHS = 30


@pytest.fixture(scope="module")
def server(postgres, tmp_path_factory):
    """Yield a server that tests may stop; each must start it again."""
    with mlflow_server(tmp_path_factory.mktemp("server"), postgres.make_database()) as server:
        yield server


@pytest.fixture
def opened(server):
    return open_store(server.uri, experiment="test", artifacts="-", wait_s=60.0)


def begun(opened, folder, **rest):
    store, experiment_id = opened
    return TrackedRun.start(store, experiment_id, name="n", config={"seed": 3}, tags={}, folder=folder, **rest)


def histories(uri, run_id):
    client = MlflowClient(uri)
    names = client.get_run(run_id).data.metrics
    return {name: [(point.step, point.value) for point in client.get_metric_history(run_id, name)] for name in names}


def test_what_a_run_could_not_upload_the_next_start_uploads(server, opened, tmp_path, monkeypatch, capfd):
    tracked = begun(opened, tmp_path)
    server.stop()
    tracked.log_metrics({"x": 1.0}, n_env_steps=7)
    assert not tracked.end("FINISHED", wait_s=0.1)
    # A run that is still going on uploads by itself; one whose folder was removed is forgotten.
    gone = tmp_path / "gone"
    server.start()
    going_on, removed = begun(opened, tmp_path / "going on"), begun(opened, gone)
    # Otherwise its thread would write into the folder while it is removed.
    assert removed._uploader.finish(HANG_S) is None
    removed._outbox.close()
    shutil.rmtree(gone)
    assert {tracked.run_id, going_on.run_id, removed.run_id} <= pending_runs().keys()
    # A record that was only partly written does no harm.
    (cache_folder() / "undelivered" / "0").write_bytes(b"\0")
    # In the package's namespace, `sync` is the function.
    monkeypatch.setattr(sys.modules["armscan.tracking.sync"], "_looked_for", set())
    for _ in range(2):
        upload_pending(opened[0])
    wait_until(lambda: tracked.run_id not in pending_runs())
    assert histories(server.uri, tracked.run_id) == {"x": [(7, 1.0)]}
    assert MlflowClient(server.uri).get_run(tracked.run_id).info.status == "FINISHED"
    assert f"run {tracked.run_id}: " in capfd.readouterr().out.splitlines()[-1]
    assert going_on.end("FINISHED")
    assert not {tracked.run_id, going_on.run_id} & pending_runs().keys()


def test_run_goes_on_while_the_server_is_unavailable_and_nothing_is_lost_or_there_twice(
    server, opened, tmp_path, capfd, monkeypatch
):
    tracked = begun(opened, tmp_path)
    send, senders = requests.Session.send, set()

    def noted_send(*args, **kwargs):
        senders.add(threading.current_thread())
        return send(*args, **kwargs)

    monkeypatch.setattr(requests.Session, "send", noted_send)
    for epoch in range(N_EPOCHS):
        if epoch == 5:
            server.stop()
        if epoch == 20:
            server.start()
        tracked.log_metrics({"x": 1.0 * epoch, "y": -1.0}, n_env_steps=epoch)
        time.sleep(0.1)
    file = tmp_path / "best.pt"
    file.write_text("weights")
    tracked.log_files(file)
    # With an unavailable server each request takes seconds; a training only waits for a line in a file.
    assert senders
    assert threading.current_thread() not in senders
    assert tracked.end("FINISHED")
    assert histories(server.uri, tracked.run_id) == {
        "x": [(epoch, 1.0 * epoch) for epoch in range(N_EPOCHS)],
        "y": [(epoch, -1.0) for epoch in range(N_EPOCHS)],
    }
    client = MlflowClient(server.uri)
    run = client.get_run(tracked.run_id)
    assert (run.info.status, run.data.params) == ("FINISHED", {"seed": "3"})
    assert [file.path for file in client.list_artifacts(tracked.run_id)] == ["best.pt"]
    said = [line.partition("  ")[2] for line in capfd.readouterr().out.splitlines()]
    # Once each, and between them at most the line that the end of the run waits.
    first = f"{server.uri} cannot be reached or written to (Connection refused): entries are buffered in "
    assert said[0] == first + str(file_of(tmp_path, tracked.run_id))
    assert said[-1] == f"{server.uri} is back: everything is uploaded"
    assert len(said) <= 3


def test_run_waits_at_its_end_for_a_server_that_comes_back(server, opened, tmp_path, capfd):
    tracked = begun(opened, tmp_path)
    server.stop()
    back = threading.Timer(4.0, server.start)
    back.start()
    tracked.log_metrics({"x": 1.0}, n_env_steps=7)
    assert tracked.end("FINISHED")
    back.join()
    assert MlflowClient(server.uri).get_run(tracked.run_id).info.status == "FINISHED"
    assert histories(server.uri, tracked.run_id) == {"x": [(7, 1.0)]}
    assert capfd.readouterr().out.count("waiting up to 60 s for http://") == 1


def test_run_whose_server_never_comes_back_is_uploaded_once_by_track_sync(server, opened, tmp_path, capfd):
    store, experiment_id = opened
    store.wait_s = 0.5
    tracked = begun((store, experiment_id), tmp_path)
    server.stop()
    (tmp_path / "curve.png").write_text("picture")
    tracked.log_files(tmp_path / "curve.png")
    tracked.log_metrics({"x": 1.0}, n_env_steps=7)
    try:
        assert not tracked.end("FINISHED")
        assert f"armscan runs sync {tmp_path} uploads the rest" in capfd.readouterr().out
        assert main(["runs", "sync", str(tmp_path)]) == 1
        assert "the rest is left: tracking.uri is 'http://" in (told := capfd.readouterr().out)
        assert "this store cannot be used: Connection refused" in told
    finally:
        server.start()
    assert MlflowClient(server.uri).get_run(tracked.run_id).info.status == "RUNNING"
    assert main(["runs", "sync", str(tmp_path)]) == 0
    assert f"run {tracked.run_id} in {tmp_path}: " in capfd.readouterr().out
    assert main(["runs", "sync", str(tmp_path)]) == 0
    assert "nothing left to upload" in capfd.readouterr().out
    assert histories(server.uri, tracked.run_id) == {"x": [(7, 1.0)]}
    client = MlflowClient(server.uri)
    assert client.get_run(tracked.run_id).info.status == "FINISHED"
    assert [file.path for file in client.list_artifacts(tracked.run_id)] == ["curve.png"]


def test_upload_whose_answer_is_lost_is_not_there_twice(server, opened, tmp_path, monkeypatch):
    tracked = begun(opened, tmp_path)
    upload, calls = uploader._upload, Counter()

    def lost(client, outbox, kind, values):
        upload(client, outbox, kind, values)
        calls[kind] += 1
        if calls[kind] == 1:
            raise ConnectionResetError(104, "Connection reset by peer")

    monkeypatch.setattr(uploader, "_upload", lost)
    tracked.log_metrics({"x": 1.0, "z": 2.0}, n_env_steps=7)
    tracked.set_tags({"a": "b"})
    assert tracked.end("FINISHED")
    assert calls["metrics"] > 1
    assert histories(server.uri, tracked.run_id) == {"x": [(7, 1.0)], "z": [(7, 2.0)]}


def test_run_that_is_made_while_the_server_becomes_unavailable_is_made_once(server, opened, tmp_path, monkeypatch):
    _, experiment_id = opened
    store, _ = open_store(server.uri, experiment="test", artifacts="-", wait_s=60.0, retry_s=60.0)
    create, asked = store.mlflow.create_run, []

    def lost(*args, **kwargs):
        asked.append(create(*args, **kwargs))
        raise ConnectionResetError(104, "Connection reset by peer")

    monkeypatch.setattr(store.mlflow, "create_run", lost)
    run = store.create_run(experiment_id, name="once", tags={})
    assert [each.info.run_id for each in asked] == [run.info.run_id]


def test_store_is_waited_for_with_a_retry_policy(server, capfd):
    server.stop()
    with pytest.raises(TrackingError, match="this store cannot be used: Connection refused"):
        open_store(server.uri, experiment="test", artifacts="-", wait_s=1.0)
    with pytest.raises(TrackingUnavailableError, match=r"has been unavailable for 0\.1 s: Connection refused"):
        open_store(server.uri, experiment="test", artifacts="-", wait_s=1.0, retry_s=0.1)
    back = threading.Timer(1.0, server.start)
    back.start()
    _, experiment_id = open_store(server.uri, experiment="test", artifacts="-", wait_s=1.0, retry_s=60.0)
    back.join()
    assert experiment_id
    said = [line.partition("  ")[2] for line in capfd.readouterr().out.splitlines()]
    assert said[-2:] == [
        "the tracking store is unavailable (Connection refused): waiting",
        "the tracking store is back",
    ]


def test_figures_are_kept_where_files_cannot_be_because_the_disk_is_full(tmp_path, monkeypatch, capfd):
    """A file in the way of the folder stands in for a full disk: both raise an `OSError`."""
    uri, artifacts = f"sqlite:///{tmp_path}/runs.db", tmp_path / "artifacts"
    store, experiment_id = open_store(uri, experiment="test", artifacts=str(artifacts), wait_s=1.0)
    artifacts.write_text("in the way")
    tracked = begun((store, experiment_id), tmp_path / "run")
    (tmp_path / "run" / "best.pt").write_text("weights")
    tracked.log_files(tmp_path / "run" / "best.pt")
    tracked.log_metrics({"x": 1.0}, n_env_steps=7)
    assert not tracked.end("FINISHED")
    assert "cannot be reached or written to" in capfd.readouterr().out
    assert histories(uri, tracked.run_id) == {"x": [(7, 1.0)]}
    assert MlflowClient(uri).get_run(tracked.run_id).info.status == "FINISHED"
    artifacts.unlink()
    assert main(["runs", "sync", str(tmp_path / "run")]) == 0
    assert [file.path for file in MlflowClient(uri).list_artifacts(tracked.run_id)] == ["best.pt"]


@pytest.fixture
def artifacts_disk(tmp_path):
    """Yield a disk of 256 KiB for the server's artifacts."""
    with small_disk(tmp_path / "server" / "artifacts", "256k") as disk:
        yield disk


def test_run_ends_where_the_servers_disk_is_full_and_its_files_are_uploaded_later(artifacts_disk, tmp_path, capfd):
    with mlflow_server(tmp_path / "server", f"sqlite:///{tmp_path}/runs.db") as server:
        assert server.artifacts == artifacts_disk.folder
        store, experiment_id = open_store(server.uri, experiment="test", artifacts="-", wait_s=20.0)
        tracked = begun((store, experiment_id), tmp_path / "run")
        weights = tmp_path / "run" / "best.pt"
        weights.write_bytes(os.urandom(2**20))
        tracked.log_files(weights)
        tracked.log_metrics({"x": 1.0}, n_env_steps=7)
        assert not tracked.end("FINISHED")
        assert capfd.readouterr().out.count("cannot be reached or written to") == 1
        assert histories(server.uri, tracked.run_id) == {"x": [(7, 1.0)]}
        client = MlflowClient(server.uri)
        assert client.get_run(tracked.run_id).info.status == "FINISHED"
        artifacts_disk.enlarge("16m")
        assert main(["runs", "sync", str(tmp_path / "run")]) == 0
        kept = client.download_artifacts(tracked.run_id, "best.pt", str(tmp_path))
        assert Path(kept).read_bytes() == weights.read_bytes()


def test_run_that_was_deleted_meanwhile_is_not_waited_for(opened, server, tmp_path, capfd):
    tracked = begun(opened, tmp_path)
    assert tracked._uploader._is_done.wait(HANG_S)
    MlflowClient(server.uri).delete_run(tracked.run_id)
    tracked.log_metrics({"x": 1.0}, n_env_steps=7)
    began_s = time.monotonic()
    assert not tracked.end("FINISHED", wait_s=HANG_S)
    assert time.monotonic() - began_s < HANG_S
    assert "refuses entries" in capfd.readouterr().out


def test_runs_of_a_dead_process_are_ended_and_those_of_a_living_one_are_not(opened, server, tmp_path):
    store, _ = opened
    dead, alive = begun(opened, tmp_path / "dead"), begun(opened, tmp_path / "alive")
    dead.log_metrics({"x": 1.0}, n_env_steps=7)
    # As the system does with a killed process.
    dead._uploader._stopped.set()
    dead._outbox.close()
    fail_dead_runs(tmp_path, store, "its worker died")
    client = MlflowClient(server.uri)
    run = client.get_run(dead.run_id)
    assert (run.info.status, run.data.tags["failure"]) == ("FAILED", "its worker died")
    assert histories(server.uri, dead.run_id) == {"x": [(7, 1.0)]}
    assert client.get_run(alive.run_id).info.status == "RUNNING"
    assert [upload.left for upload in sync(tmp_path, lambda _: store)] == ["it is still in progress"]
    alive.end("FINISHED")


def test_sync_goes_on_after_what_it_cannot_upload(opened, server, tmp_path, capfd):
    store, _ = opened
    runs = [begun(opened, tmp_path / name) for name in ("damaged", "elsewhere", "whole")]
    for run in runs:
        run._uploader.finish(60.0)
        run.log_files(tmp_path / run._outbox.folder / "best.pt")
        run.log_metrics({"x": 1.0}, n_env_steps=7)
        run._outbox.close()
    with runs[0]._outbox.file.open("ab") as file:
        file.write(b"nonsense\n")
    (tmp_path / "whole" / "best.pt").write_text("weights")
    assert main(["runs", "sync", str(tmp_path)]) == 1
    told = capfd.readouterr().out
    assert "a line is damaged: b'nonsense" in told
    assert f"the rest is left: {tmp_path}/elsewhere/best.pt is not there" in told
    assert histories(server.uri, runs[2].run_id) == {"x": [(7, 1.0)]}
    # An outbox that was copied without its files is not taken for uploaded: they may still come.
    (tmp_path / "elsewhere" / "best.pt").write_text("weights")
    assert [upload.left for upload in sync(tmp_path / "elsewhere", lambda _: store, trust=True)] == [None]
    files = MlflowClient(server.uri).list_artifacts(runs[1].run_id)
    assert [file.path for file in files] == ["best.pt"]


def test_end_of_a_run_is_noted_without_its_store(opened, server, tmp_path):
    store, experiment_id = opened
    run_id = store.create_run(experiment_id, name="parent", tags={}).info.run_id
    record_end(tmp_path, run_id, server.uri, "FAILED", {"failure.0": "no luck"})
    assert main(["runs", "sync", str(tmp_path)]) == 0
    run = MlflowClient(server.uri).get_run(run_id)
    assert (run.info.status, run.data.tags["failure.0"]) == ("FAILED", "no luck")


def test_run_that_cannot_be_made_is_answered_in_one_line(server, opened, tmp_path):
    server.stop()
    try:
        with pytest.raises(
            TrackingUnavailableError, match=r"tracking.uri is 'http://.*cannot be used: Connection refused"
        ):
            begun(opened, tmp_path)
    finally:
        server.start()


@pytest.mark.parametrize("uri", ["http://[bad", "http://host:port", "http://"])
def test_address_that_is_none_is_answered_at_once(uri):
    with pytest.raises(TrackingError, match="but a server's address must have a host"):
        open_store(uri, experiment="test", artifacts="-", wait_s=1.0)


@pytest.mark.parametrize("words", [["sync"], ["sink", "."], ["sync", "nowhere"], ["sync", ".", "--other=3"]])
def test_sync_answers_a_mistake_in_one_line(words, capsys):
    assert main(["runs", *words]) == 2
    answer = capsys.readouterr().err
    assert answer.startswith("error: ")
    assert answer.count("\n") == 1


def test_reason_shows_no_password(monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "hidden")
    error = OSError("http://me:other@host:1/: hidden is wrong")
    assert unavailable_reason(error) == reason_in(error) == "http://me:***@host:1/: *** is wrong"


def test_reason_of_a_database_has_neither_the_statement_nor_its_parameters():
    error = sqlalchemy.exc.OperationalError("INSERT INTO tags", ("secret",), OSError("database or disk is full"))
    assert reason_in(error) == "(builtins.OSError) database or disk is full"

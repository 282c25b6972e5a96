"""Runs in MLflow, on a real SQLite store."""

import contextlib
import dataclasses
import functools
import json
import math
import shutil
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from sqlalchemy import Engine, event

import armscan
from armscan.errors import InvalidValueError, TrackingError, UntrustedError
from armscan.experiment.results import RunResult
from armscan.experiment.runner import keep_results
from armscan.tracking import (
    TrackedRun,
    code_state,
    draw_learning_curve,
    find_run,
    load_run,
    open_existing_store,
    open_store,
    uploader,
)
from armscan.tracking.outbox import Address, Outbox, file_of
from armscan.tracking.pending_runs import PENDING_FOLDER, PendingRun, pending_runs
from armscan.tracking.sanitize import flatten
from armscan.tracking.sync import _upload_pending, sync
from armscan.tracking.tags import DESCRIPTION_TAG, VERSION_TAG
from armscan.tracking.uploader import upload
from armscan.training import EpochReport, TrainingResult
from armscan.utils.files import sha256
from armscan.utils.processes import ProcessInfo
from armscan.utils.run_files import RESULT_SHA256_TAGS
from tests.support.stores import store_in
from tests.support.waiting import wait_until
from tests.training.test_train import evaluation_of

REPORTS = [
    EpochReport(
        epoch=epoch,
        n_env_steps=100 * epoch,
        wall_s=1.0 * epoch,
        metrics={"train/length": 9.0 / epoch, "train/return": -3.0},
        evaluation=evaluation_of(9 // epoch),
        is_best=True,
    )
    for epoch in (1, 2, 3)
]


@pytest.fixture
def store(tmp_path, database):
    return store_in(tmp_path, "test")


def eventually(look, is_there):
    """Wait until `look` returns what `is_there` accepts, and return that."""
    wait_until(lambda: is_there(look()), log=look)
    return look()


def test_tracked_run_keeps_parameters_curves_results_and_files(store, tmp_path):
    client, experiment_id = store
    config = {"agent": {"lr": 0.1, "sizes": [1, 2]}, "seed": 3}
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "best.pt").write_text("weights")
    with TrackedRun.start(
        client, experiment_id, name="n", config=config, tags={"overrides": "seed=3"}, folder=folder
    ) as tracked:
        tracked.on_start(300, ())
        for report in REPORTS:
            tracked.on_epoch(report)
        tracked.on_end()
        keep_results(
            tracked,
            TrainingResult(tuple(REPORTS), is_solved=False, wall_s=3.0),
            RunResult({"test volumes": evaluation_of(2, 4)}, {"random": evaluation_of(9)}),
            folder,
        )
        draw_learning_curve(REPORTS, folder / "learning_curve.png", title="n")
        tracked.log_results(folder)
    run = client.get_run(tracked.run_id)
    assert run.info.status == "FINISHED"
    assert run.data.params == {"agent.lr": "0.1", "agent.sizes": "[1, 2]", "seed": "3"}
    assert run.data.tags["overrides"] == "seed=3"
    for name, tag in RESULT_SHA256_TAGS.items():
        assert run.data.tags[tag] == sha256((folder / name).read_bytes())
    assert run.data.tags["git.commit"] == code_state().tags["git.commit"]
    assert run.data.metrics["test_volumes/mean_steps"] == 3.0
    assert run.data.metrics["test_volumes/on_plane_5mm_10deg"] == 1.0
    assert run.data.metrics["test_volumes/mean_steps_low"] == 2.0
    assert run.data.metrics["random/mean_steps"] == 9.0
    assert run.data.metrics["best_env_step"] == 300
    note = run.data.tags["mlflow.note.content"]
    assert note.startswith("**On plane, 5 mm 10°: agent 100.0% (34.2–100.0), random 100.0%.")
    assert "\n| with 95 % intervals | agent, test | random, test |" in note
    assert note.endswith(f"![learning curve](get-artifact?path=learning_curve.png&run_uuid={tracked.run_id})")
    (model,) = client.search_logged_models([experiment_id])
    assert [each.model_id for each in run.outputs.model_outputs] == [model.model_id]
    history = client.get_metric_history(tracked.run_id, "validation/mean_steps")
    assert [(point.step, point.value) for point in history] == [(100, 9.0), (200, 4.0), (300, 3.0)]
    files = {file.path for file in client.list_artifacts(tracked.run_id)}
    assert files == {"best.pt", "evaluation.json", "baselines.json", "results.html", "learning_curve.png"}


def test_metric_that_is_not_valid_any_more_is_replaced_by_nan_where_that_is_asked_for(store, tmp_path):
    client, experiment_id = store
    run_id = client.create_run(experiment_id, name="n", tags={}).info.run_id
    for value, options in ((1.0, {}), (math.nan, {"keeps_nan": True})):
        with TrackedRun.open_existing(client, run_id, name="n", folder=tmp_path / str(value)) as tracked:
            tracked.log_metrics({"a": value}, n_env_steps=0, **options)
            tracked.log_metrics({"b": 2.0 * value}, n_env_steps=0)
    metrics = client.get_run(run_id).data.metrics
    assert math.isnan(metrics["a"])
    assert metrics["b"] == 2.0


def test_store_that_takes_long_is_waited_for_as_long_as_it_takes_entries(store, tmp_path, monkeypatch):
    client, experiment_id = store
    clock_s, upload_entries = [0.0], uploader._upload

    def slow_upload(*arguments):
        upload_entries(*arguments)
        # Longer than the pause between two looks.
        time.sleep(1.2 * uploader.POLL_S)
        clock_s[0] += 40.0

    monkeypatch.setattr(uploader, "_upload", slow_upload)
    monkeypatch.setattr(uploader, "time", SimpleNamespace(monotonic=lambda: clock_s[0]))
    tracked = TrackedRun.start(client, experiment_id, name="n", config={}, tags={}, folder=tmp_path)
    for number in range(3):
        (tmp_path / f"{number}.pt").write_text("weights")
        tracked.log_files(tmp_path / f"{number}.pt")
    assert tracked.end("FINISHED", wait_s=60.0)
    assert clock_s[0] > 2 * 60.0


def test_metrics_of_volumes_of_any_name_reach_the_store(store, tmp_path):
    client, experiment_id = store
    tracked = TrackedRun.start(client, experiment_id, name="n", config={}, tags={}, folder=tmp_path)
    names = ["arm (1).nii.gz", "arm+1", "ä" * 300, "a/../b", "plain"]
    tracked.log_metrics({f"test/volume/{name}/mean_steps": 1.0 for name in names}, n_env_steps=0)
    assert tracked.end("FINISHED")
    metrics = client.get_run(tracked.run_id).data.metrics
    assert len(metrics) == len(names)
    assert all(name.endswith("/mean_steps") and len(name) <= 250 for name in metrics)
    assert "test/volume/plain/mean_steps" in metrics


def test_name_is_no_longer_than_every_database_takes(store):
    client, experiment_id = store
    assert client.create_run(experiment_id, name="n" * 300, tags={}).info.run_name == "n" * 250


def test_description_of_a_person_stays_and_armscans_is_replaced(store):
    client, experiment_id = store
    run_id = client.create_run(experiment_id, name="n", tags={}).info.run_id
    requests = Mock(wraps=client.mlflow.log_batch)
    for text in ("first", "second"):
        uploader.set_description(SimpleNamespace(get_run=client.get_run, log_batch=requests), run_id, text)
        # A description without its checksum would pass for a person's.
        assert requests.call_args.kwargs["tags"][0].value == text
        assert client.get_run(run_id).data.tags[DESCRIPTION_TAG] == text
    client.mlflow.set_tag(run_id, DESCRIPTION_TAG, "a person's")
    uploader.set_description(client.mlflow, run_id, "third")
    assert client.get_run(run_id).data.tags[DESCRIPTION_TAG] == "a person's"


def test_tracked_run_keeps_a_folder_with_all_in_it_and_what_makes_it_a_model_last(store, tmp_path):
    client, experiment_id = store
    model = tmp_path / "run" / "policy"
    contents = {"MLmodel": "m", "artifacts/policy.pt2": "p", "artifacts/more/a": "a", "zero": "z"}
    for name, text in contents.items():
        (model / name).parent.mkdir(parents=True, exist_ok=True)
        (model / name).write_text(text)
    (tmp_path / "run" / "beside").write_text("not in it")
    with TrackedRun.start(client, experiment_id, name="n", config={}, tags={}, folder=tmp_path / "run") as tracked:
        tracked.log_folder(model)
    entries = [json.loads(line) for line in file_of(tmp_path / "run", tracked.run_id).read_text().splitlines()]
    files = [entry["file"] for entry in entries if "file" in entry]
    assert files[-1] == ["policy/MLmodel", "policy"]
    assert ["policy/artifacts/more/a", "policy/artifacts/more"] in files
    assert [file.path for file in client.list_artifacts(tracked.run_id)] == ["policy"]
    kept = client.download_artifacts(tracked.run_id, "policy", str(tmp_path))
    for name, text in contents.items():
        assert (Path(kept) / name).read_text() == text


def test_folder_that_was_removed_before_it_was_uploaded_is_told(store, tmp_path, capsys):
    client, experiment_id = store
    run_id = client.create_run(experiment_id, name="n", tags={}).info.run_id
    outbox = Outbox.begin(tmp_path, Address(run_id, client.uri))
    outbox.add(file=["policy/MLmodel", "policy"])
    outbox.add(file="best.pt")
    # If the folder was copied, the file may be elsewhere.
    with pytest.raises(FileNotFoundError, match="policy/MLmodel is not there"):
        upload(outbox, client.mlflow, "files", is_whole=False)
    assert upload(outbox, client.mlflow, "files") == 2
    outbox.close()
    said = capsys.readouterr().out
    assert "policy/MLmodel was removed before the store could keep it" in said
    assert "best.pt was removed" in said


@pytest.mark.parametrize("status", ["FINISHED", "KILLED"])
def test_run_whose_folder_was_removed_fails_at_once(store, tmp_path, capsys, status):
    client, experiment_id = store
    folder = tmp_path / "run"
    tracked = TrackedRun.start(client, experiment_id, name="n", config={}, tags={}, folder=folder)

    def is_removed():
        # The run's own thread may write there meanwhile.
        shutil.rmtree(folder, ignore_errors=True)
        return not folder.exists()

    wait_until(is_removed)
    refused = pytest.raises(TrackingError, match=r"its folder .* was removed")
    with refused if status == "FINISHED" else contextlib.nullcontext():
        # It would wait for a store that is unavailable.
        tracked.end(status, wait_s=60.0)
    run = client.get_run(tracked.run_id)
    assert run.info.status == "FAILED"
    assert "was removed before everything was uploaded" in run.data.tags["failure"]
    assert "unavailable" not in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["above", "absolute", "link"])
def test_file_outside_of_a_strangers_folder_is_not_uploaded(store, tmp_path, kind):
    client, experiment_id = store
    (tmp_path / "secret").write_text("secret")
    folder = tmp_path / "theirs"
    run_id = client.create_run(experiment_id, name="n", tags={"folder": str(folder)}).info.run_id
    names = {"above": "../secret", "absolute": str(tmp_path / "secret"), "link": "link"}
    outbox = Outbox.begin(folder, Address(run_id, client.uri))
    (folder / "link").symlink_to(tmp_path / "secret")
    outbox.add(file=names[kind])
    outbox.close()
    (uploaded,) = sync(tmp_path, lambda _: client)
    assert "is outside of the run's folder" in uploaded.left
    assert client.list_artifacts(run_id) == []
    # Nor by a process that resumes the run.
    with contextlib.closing(Outbox.begin(folder, Address(run_id, client.uri))) as outbox:
        outbox.mark_pending(client.uri)
        with pytest.raises(UntrustedError, match="add --trust"):
            upload(outbox, client.mlflow, "files")
    assert client.list_artifacts(run_id) == []
    # Nor by a later start, though this machine has noted that something is left.
    assert run_id in pending_runs()
    _upload_pending(client)
    assert client.list_artifacts(run_id) == []
    (uploaded,) = sync(tmp_path, lambda _: client, trust=True)
    assert uploaded.left is None
    assert len(client.list_artifacts(run_id)) == 1


@pytest.mark.parametrize(
    ("process", "is_kept"), [({"host": "elsewhere"}, True), ({"pid_namespace": "other"}, True), ({"boot": "1"}, False)]
)
def test_pending_run_of_another_machine_stays_if_its_folder_is_not_here(store, tmp_path, monkeypatch, process, is_kept):
    monkeypatch.setenv("ARMSCAN_CACHE", str(tmp_path / "cache"))
    client, experiment_id = store
    run_id = client.create_run(experiment_id, name="n", tags={}).info.run_id
    folder = tmp_path / "cache" / PENDING_FOLDER
    folder.mkdir(parents=True)
    noted = dataclasses.replace(ProcessInfo.current(), **process)
    PendingRun(tmp_path / "local to a node" / "outbox", client.uri, noted).write(folder / run_id)
    _upload_pending(client)
    assert (run_id in pending_runs()) == is_kept


@pytest.mark.parametrize("tags", [{}, {"folder": "/mine"}], ids=["a study's", "a training's"])
def test_strangers_folder_that_names_a_run_of_mine_writes_nothing_to_it(store, tmp_path, tags):
    client, experiment_id = store
    run_id = client.create_run(experiment_id, name="n", tags=tags).info.run_id
    with contextlib.closing(Outbox.begin(tmp_path / "theirs", Address(run_id, client.uri))) as outbox:
        outbox.add(tags={"x": "theirs"})
        outbox.add(metrics=[("x", 1.0, 0, 0)])
        outbox.add(status=("FAILED", 1))
    (uploaded,) = sync(tmp_path, lambda _: client)
    assert "the run was not tracked from here" in uploaded.left
    assert "add --trust" in uploaded.left
    run = client.get_run(run_id)
    assert (run.info.status, run.data.metrics, run.data.tags.get("x")) == ("RUNNING", {}, None)
    (uploaded,) = sync(tmp_path, lambda _: client, trust=True)
    assert uploaded.left is None
    assert client.get_run(run_id).info.status == "FAILED"


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt(), "KILLED"), (ValueError("no"), "FAILED")])
def test_tracked_run_says_how_it_ended(store, tmp_path, error, status):
    client, experiment_id = store

    def fail():
        with TrackedRun.start(client, experiment_id, name="n", config={}, tags={}, folder=tmp_path) as tracked:
            ids.append(tracked.run_id)
            raise error

    ids = []
    with pytest.raises(type(error)):
        fail()
    run = client.get_run(ids[0])
    assert run.info.status == status
    assert run.data.tags["failure"]


def test_runs_are_children_of_their_parent(store, tmp_path):
    client, experiment_id = store
    with TrackedRun.start(client, experiment_id, name="parent", config={}, tags={}, folder=tmp_path) as parent:
        pass
    with TrackedRun.start(
        client, experiment_id, name="child", config={}, tags={}, folder=tmp_path, parent_id=parent.run_id
    ):
        pass
    (child,) = client.search_runs([experiment_id], f"tags.mlflow.parentRunId = '{parent.run_id}'")
    assert child.info.run_name == "child"


def test_run_that_goes_on_logs_what_is_missing_and_nothing_twice(store, tmp_path):
    client, experiment_id = store
    first = TrackedRun.start(
        client, experiment_id, name="n", config={"seed": 3}, tags={"folder": "here"}, folder=tmp_path
    )
    first.on_epoch(REPORTS[0])
    first.end("KILLED", reason="interrupted")
    # MLflow would refuse another value of a parameter, and all entries after it.
    config = {"seed": 5, "more": 4}
    run = client.get_run(first.run_id)
    second = TrackedRun.reopen(client, run, folder=tmp_path, config=config, tags={"folder": "there"})
    run = eventually(lambda: client.get_run(first.run_id), lambda run: "more" in run.data.params)
    assert run.info.status == "RUNNING"
    assert "failure" not in run.data.tags
    assert (run.data.tags["resumed"], run.data.tags["folder"]) == ("1", "there")
    assert run.data.params == {"seed": "3", "more": "4"}
    second.on_start(300, REPORTS[:2])
    second.on_epoch(REPORTS[2])
    second.end("FINISHED")
    for name, values in {"validation/mean_steps": [9.0, 4.0, 3.0], "wall_s": [1.0, 2.0, 3.0]}.items():
        history = client.get_metric_history(first.run_id, name)
        assert [(point.step, point.value) for point in history] == list(zip([100, 200, 300], values, strict=True))
    assert client.get_run(first.run_id).info.status == "FINISHED"


def test_store_whose_artifacts_cannot_be_written_is_refused_before_anything_is_made(tmp_path):
    (tmp_path / "taken").write_text("no folder")
    uri = f"sqlite:///{tmp_path}/runs.db"
    with pytest.raises(TrackingError, match=r"the artifacts of runs lie in .*taken/inside.*: Not a directory"):
        open_store(uri, experiment="new", artifacts=str(tmp_path / "taken" / "inside"), wait_s=60.0)
    client, _ = open_store(uri, experiment="other", artifacts=str(tmp_path / "artifacts"), wait_s=60.0)
    assert {each.name for each in client.search_experiments()} == {"Default", "other"}
    # An existing experiment determines where its artifacts lie.
    (tmp_path / "artifacts").write_text("no folder")
    with pytest.raises(TrackingError, match=r"the artifacts of runs lie in .*artifacts, as their experiment"):
        open_store(uri, experiment="other", artifacts="elsewhere", wait_s=60.0)


def test_existing_store_is_not_made_of_a_database_with_something_else(tmp_path):
    other, empty = tmp_path / "other.db", tmp_path / "empty.db"
    with contextlib.closing(sqlite3.connect(other)) as connection:
        connection.execute("CREATE TABLE runs (mine)")
        connection.commit()
    empty.touch()
    for database in (other, empty):
        before = database.read_bytes()
        with pytest.raises(TrackingError, match=f"{database} is not an MLflow store: give the one with the runs"):
            open_existing_store(f"sqlite:///{database}")
        assert database.read_bytes() == before


def test_experiment_of_a_name_that_is_too_long_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(TrackingError, match="has 20000 characters, but it must have at most 500"):
        open_store(f"sqlite:///{tmp_path}/runs.db", experiment="x" * 20_000, artifacts="artifacts", wait_s=60.0)
    assert not any(tmp_path.iterdir())


def test_store_with_read_only_artifacts_is_refused(tmp_path, made_read_only):
    (folder := tmp_path / "artifacts").mkdir()
    with (
        made_read_only(folder),
        pytest.raises(TrackingError, match=r"no file can be written there: Read-only file system"),
    ):
        open_store(f"sqlite:///{tmp_path}/runs.db", experiment="e", artifacts=str(folder), wait_s=60.0)


def test_found_run_refuses_one_of_a_newer_version(store):
    client, experiment_id = store
    run = client.create_run(experiment_id, name="n", tags={VERSION_TAG: "99.1.0"})
    with pytest.raises(
        TrackingError, match=f"made by armscan 99.1.0, but this is {armscan.__version__}: it needs that"
    ):
        load_run(client.uri, run.info.run_id)


def test_find_run_takes_the_beginning_of_an_id_and_names_what_is_wrong(store):
    client, experiment_id = store
    ids = [client.create_run(experiment_id, name="n", tags={}).info.run_id for _ in range(17)]
    assert {find_run(client, run_id).info.run_id for run_id in ids} == set(ids)
    firsts = [run_id[0] for run_id in ids]
    twice = next(first for first in firsts if firsts.count(first) > 1)
    with pytest.raises(TrackingError, match=f"the run is '{twice}', but that may be {twice}.*: give more of the ID"):
        find_run(client, twice)
    shortest = next(ids[0][:n] for n in range(1, 33) if sum(other.startswith(ids[0][:n]) for other in ids) == 1)
    assert find_run(client, shortest).info.run_id == ids[0]
    for nonsense in ("", "%", "' OR 1=1", "XYZ", 33 * "a"):
        with pytest.raises(TrackingError, match="but it must be an ID as MLflow shows it"):
            find_run(client, nonsense)
    with pytest.raises(TrackingError, match=r"no run of sqlite:.* has an ID that begins with it"):
        find_run(client, 32 * "a")


def test_open_existing_store_makes_nothing(tmp_path):
    with pytest.raises(TrackingError, match="but there is no "):
        open_existing_store(f"sqlite:///{tmp_path}/runs.db")
    assert not list(tmp_path.iterdir())


def test_store_whose_tables_were_being_created_when_it_was_interrupted_is_created_anew(tmp_path):
    statements = []

    def interrupt(*_):
        statements.append(1)
        # Within a migration, from which MLflow does not recover.
        if len(statements) == 100:
            raise KeyboardInterrupt

    uri = f"sqlite:///{tmp_path}/runs.db"
    opened = functools.partial(open_store, uri, experiment="test", artifacts=str(tmp_path), wait_s=1.0)
    event.listen(Engine, "after_cursor_execute", interrupt)
    with pytest.raises(KeyboardInterrupt):
        opened()
    event.remove(Engine, "after_cursor_execute", interrupt)
    store, experiment_id = opened()
    assert store.get_experiment(experiment_id).name == "test"


@pytest.mark.full
def test_many_processes_may_open_a_fresh_store_at_once(tmp_path):
    script = (
        "import sys; from armscan.tracking import open_store\n"
        "print(open_store(sys.argv[1], experiment='test', artifacts='artifacts', wait_s=1.0)[1])"
    )
    command = [sys.executable, "-c", script, f"sqlite:///{tmp_path}/fresh.db"]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, cwd=tmp_path) for _ in range(4)]
    answers = {process.communicate()[0] for process in processes}
    assert [process.returncode for process in processes] == [0] * 4
    assert len(answers) == 1


@pytest.mark.parametrize("uri", ["./mlruns", "nonsense://x", "sqlite:////proc/no/runs.db", "sqlite:///", "", None, 3])
def test_open_store_names_a_store_that_cannot_be_used(uri):
    with pytest.raises(TrackingError, match=r"tracking\.uri is"):
        open_store(uri, experiment="test", artifacts="artifacts", wait_s=1.0)


def test_open_store_names_a_folder_in_the_place_of_the_store(tmp_path):
    (tmp_path / "runs.db").mkdir()
    with pytest.raises(TrackingError, match="Is a directory"):
        open_store(f"sqlite:///{tmp_path}/runs.db", experiment="test", artifacts="artifacts", wait_s=1.0)


def test_open_store_names_a_damaged_store(tmp_path):
    (tmp_path / "runs.db").write_bytes(b"no database at all" * 100)
    with pytest.raises(TrackingError, match="not a database"):
        open_store(f"sqlite:///{tmp_path}/runs.db", experiment="test", artifacts="artifacts", wait_s=1.0)


def test_flattened_gives_dotted_keys_and_keeps_lists():
    assert flatten({"a": {"b": 1, "c": {"d": None}}, "e": [1, 2], "f": {}}) == {
        "a.b": 1,
        "a.c.d": None,
        "e": "[1, 2]",
        "f": "{}",
    }


def test_learning_curve_is_a_picture(tmp_path):
    from PIL import Image

    draw_learning_curve(REPORTS, tmp_path / "curve.png", title="test")
    with Image.open(tmp_path / "curve.png") as picture:
        assert picture.size[0] > 600
        assert len(picture.convert("RGB").getcolors(100_000)) > 20


def test_store_is_not_opened_where_the_policy_is_neither_kept_nor_not(tmp_path):
    with pytest.raises(InvalidValueError, match=r"tracking\.policy is 'maybe'"):
        open_store(f"sqlite:///{tmp_path}/runs.db", experiment="a", artifacts="b", wait_s=1.0, policy="maybe")
    assert not list(tmp_path.iterdir())


def test_opening_a_store_keeps_the_locks_that_this_process_has_on_it(tmp_path):
    file = tmp_path / "runs.db"
    opened = functools.partial(open_store, f"sqlite:///{file}", experiment="a", artifacts=str(tmp_path), wait_s=0)
    opened()
    writes = "import sqlite3, sys; sqlite3.connect(sys.argv[1], timeout=0).execute('BEGIN IMMEDIATE')"
    with contextlib.closing(sqlite3.connect(file, isolation_level=None)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        opened()
        other = subprocess.run([sys.executable, "-c", writes, str(file)], capture_output=True, text=True, check=False)
    assert "database is locked" in other.stderr

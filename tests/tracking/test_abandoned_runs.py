"""Runs whose process was killed: the next process ends them, if the process was of this machine and is gone."""

import json
import shutil
import subprocess
import sys
from dataclasses import asdict

import pytest
from mlflow import MlflowClient

from armscan.tracking import open_existing_store, sync
from armscan.tracking.notes import NOTES_FOLDER, notes
from armscan.tracking.sync import FOLDER_REMOVED, PROCESS_DIED, _upload_pending
from armscan.utils.processes import ProcessInfo

pytestmark = pytest.mark.full
KILLED = """
import os, signal, sys
from pathlib import Path
from armscan.tracking import TrackedRun, open_store
store, experiment = open_store(sys.argv[1], experiment="test", artifacts=sys.argv[2], wait_s=60.0)
tracked = TrackedRun.start(store, experiment, name="n", config={"seed": 3}, tags={}, folder=Path(sys.argv[2], "run"))
tracked._uploader.finish(60.0)
print(tracked.run_id, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def uri(tmp_path, monkeypatch):
    monkeypatch.setenv("ARMSCAN_CACHE", str(tmp_path / "cache"))
    return f"sqlite:///{tmp_path}/runs.db"


@pytest.fixture
def run_id(uri, tmp_path):
    """Return the ID of a run in the folder `run` that was killed while it trained."""
    command = [sys.executable, "-c", KILLED, uri, str(tmp_path)]
    run_id = subprocess.run(command, capture_output=True, text=True).stdout.strip()
    assert notes().keys() == {run_id}
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
        assert notes() == {}
    else:
        assert not any(upload.left for upload in sync(tmp_path, open_existing_store))
    assert ending_of(uri, run_id) == ("FAILED", FOLDER_REMOVED if is_removed else PROCESS_DIED)


@pytest.mark.parametrize("is_removed", [False, True])
@pytest.mark.parametrize(
    "changed", [{"host": "elsewhere"}, {"boot": "another"}, {"pid_namespace": "another"}, asdict(ProcessInfo.current())]
)
def test_run_of_another_machine_or_of_a_living_process_is_not_ended(uri, run_id, tmp_path, changed, is_removed):
    file = tmp_path / "cache" / NOTES_FOLDER / run_id
    note = json.loads(file.read_text())
    file.write_text(json.dumps(note | {"process": note["process"] | changed}))
    if is_removed:
        shutil.rmtree(tmp_path / "run")
    sync(tmp_path, open_existing_store)
    _upload_pending(open_existing_store(uri))
    assert ending_of(uri, run_id) == ("RUNNING", None)

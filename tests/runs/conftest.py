"""Runs that have trained nothing, in a real store, with real folders, outboxes and artifacts."""

import contextlib
import subprocess
import sys
from functools import partial

import pytest

from armscan.experiment.provenance import place_tags
from armscan.tracking import TrackedRun
from armscan.utils.files import sha256
from armscan.utils.run_files import CONFIG_FILE, SHA256_TAGS
from tests.support.stores import store_in

HOLDER = """
import sys
from filelock import FileLock
with FileLock(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def store(tmp_path, database):
    return store_in(tmp_path, "armscan", artifacts="mlartifacts")


@pytest.fixture
def make_run(store, tmp_path):
    """Make a run that has ended, as `armscan.run` leaves it; return its ID."""

    def make(
        name="tiny",
        *,
        status="FINISHED",
        tags=None,
        figures=None,
        parent_id=None,
        folder=None,
        opened=store,
        also=(),
        policy=None,
    ):
        client, experiment_id = opened
        folder = folder or tmp_path / "outputs" / name
        (folder / ".hydra").mkdir(parents=True, exist_ok=True)
        contents = {CONFIG_FILE: f"name: {name}\n".encode(), "best.pt": bytes(1000), "last.pt": bytes(2000)}
        for file, text in contents.items():
            (folder / file).write_bytes(text)
        (folder / ".hydra" / "config.yaml").write_text("a: 1\n")
        tags = {**place_tags(folder), SHA256_TAGS[CONFIG_FILE]: sha256(contents[CONFIG_FILE]), **(tags or {})}
        config = {"projection": "zy"}
        with contextlib.ExitStack() as stack:
            run = TrackedRun.start(
                client, experiment_id, name=name, config=config, tags=tags, folder=folder, parent_id=parent_id
            )
            stack.callback(run.end, status, reason=None if status == "FINISHED" else "no reason")
            run.log_metrics(figures or {}, n_env_steps=7)
            run.log_files(*(folder / file for file in (*contents, *also)))
            for file, text in (policy or {}).items():
                (folder / "policy" / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / "policy" / file).write_bytes(text)
            if policy:
                run.log_folder(folder / "policy")
        return run.run_id

    return make


@pytest.fixture
def locked():
    """Let another process hold a lock until the test ends."""
    with contextlib.ExitStack() as stack:

        def lock(file):
            holder = subprocess.Popen(
                [sys.executable, "-c", HOLDER, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
            stack.callback(holder.communicate)
            assert holder.stdout.readline() == b"held\n"

        yield lock


@pytest.fixture
def answer(armscan, monkeypatch):
    """Run `armscan runs` in this process, in the folder of the store; return its exit code and what it printed."""
    monkeypatch.setenv("COLUMNS", "80")
    return partial(armscan, "runs")


@pytest.fixture
def snapshot(tmp_path):
    """Return every file of the test's folder with its contents, except the database."""

    def look():
        files = (file for file in tmp_path.rglob("*") if not file.name.startswith("mlruns.db"))
        return {file: file.read_bytes() if file.is_file() else None for file in files}

    return look

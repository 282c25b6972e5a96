"""Runs made by a stranger: no command executes what they name."""

import contextlib
import json
import re
import shlex
import sqlite3
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
import yaml

from armscan.errors import ResumeError, UntrustedError
from armscan.launch.resume import resume
from armscan.policies.build import SUM_TAG
from armscan.policies.model import CODE, model_sha256
from armscan.tracking.outbox import Address, Outbox
from armscan.tracking.tags import DOMAIN_TAG, GRID_TAG, VERSION_TAG
from armscan.utils.files import sha256
from armscan.utils.run_files import CONFIG_FILE, SHA256_TAGS, VOLUMES_FILE
from tests.cli.test_policy import registered
from tests.support.refusals import assert_refused
from tests.support.stores import store_in
from tests.support.tracked_runs import GUESSER, store_of, tracked

# Targets in libraries that are always installed; Hydra would call each without asking.
DOORS = {
    "a shell": lambda marker: {"_target_": "torch.utils.collect_env.run", "command": f"touch {shlex.quote(marker)}"},
    "a process": lambda marker: {"_target_": "subprocess.check_output", "args": ["touch", marker]},
    "a file": lambda marker: {
        "_target_": "pathlib.Path.touch",
        "self": {"_target_": "pathlib.Path", "_args_": [marker]},
    },
}
COMMANDS = {
    "evaluate": ["evaluate", "{run}", "--episodes=3"],
    "evaluate --video": ["evaluate", "{run}", "--video"],
    "reproduce": ["runs", "reproduce", "{run}"],
    "export": ["policy", "export", "{run}", "--out=model"],
    "register": ["policy", "register", "{run}", "--name=n"],
}


@pytest.fixture(autouse=True)
def working_folder(database, tmp_path, monkeypatch):
    """Work in a folder with the user's store."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlruns.db")


def run_with(folder, text=None, **sections):
    """Track a run, replace its configuration or sections of it, and adapt the tag with its checksum."""
    run_id = tracked(folder)
    file, client = folder / CONFIG_FILE, store_of(folder)
    file.write_text(text or yaml.safe_dump(yaml.safe_load(file.read_text()) | sections))
    client.log_artifact(run_id, str(file))
    client.set_tag(run_id, SHA256_TAGS[CONFIG_FILE], sha256(file.read_bytes()))
    client.set_tag(run_id, "folder", str(folder))
    return run_id


def answered(armscan, name, run_id, *more):
    command, *words = (word.format(run=run_id) for word in [*COMMANDS[name], *more])
    return armscan(command, *words)


@pytest.mark.parametrize(("door", "section"), list(zip(DOORS, ["data", "agent", "env"], strict=True)))
def test_no_command_executes_what_a_run_names(armscan, tmp_path, door, section):
    marker = tmp_path / "executed"
    run_id = run_with(tmp_path, **{section: DOORS[door](str(marker))})
    line = f"run {run_id}: its configuration builds {section}"
    for name in COMMANDS:
        refused = answered(armscan, name, run_id)
        assert_refused(refused, line)
        assert "--trust" in refused[2]
        assert not marker.exists(), name
    store_of(tmp_path).set_terminated(run_id, "KILLED")
    with pytest.raises(UntrustedError, match=line):
        resume([f"resume={run_id}"])
    assert not marker.exists()


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [*a]",
        "a: &a {b: *a}",
        "\n".join(["a0: &a0 [1, 1]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12))]),
        "[" * 3000 + "]" * 3000,
        "a: !!python/object/apply:os.getcwd []",
        "a: 1\na: 2",
    ],
    ids=["itself", "in itself", "billion laughs", "deep", "object", "twice"],
)
def test_configuration_that_was_made_to_harm_is_one_line(armscan, tmp_path, text):
    run_id = run_with(tmp_path, text)
    code, _, errors = answered(armscan, "evaluate", run_id)
    assert (code, errors) == (2, f"error: run {run_id}: its config.yaml is damaged")
    store_of(tmp_path).set_terminated(run_id, "KILLED")
    with pytest.raises(ResumeError, match="the run's configuration is damaged"):
        resume([f"resume={run_id}"])


@pytest.mark.parametrize(
    ("tag", "value", "line"),
    [
        (DOMAIN_TAG, "x", "no training domain can be read from 'x'"),
        (DOMAIN_TAG, '{"observed": 3}', "no training domain can be read from"),
        (VERSION_TAG, "x", f"its tag {VERSION_TAG} is 'x', not a version"),
    ],
)
def test_tag_that_is_not_what_armscan_writes_is_one_line(armscan, tmp_path, tag, value, line):
    run_id = tracked(tmp_path)
    store_of(tmp_path).set_tag(run_id, tag, value)
    code, _, errors = answered(armscan, "evaluate", run_id)
    assert (code, len(errors.splitlines())) == (2, 1)
    assert line in errors


@pytest.mark.parametrize("record", ["", "x", "[]", '{"test": 3}', '{"test": {"a": 3}}'])
def test_record_of_volumes_that_is_none_is_one_line(armscan, tmp_path, record):
    run_id = tracked(tmp_path)
    (tmp_path / VOLUMES_FILE).write_text(record)
    store_of(tmp_path).log_artifact(run_id, str(tmp_path / VOLUMES_FILE))
    store_of(tmp_path).set_tag(run_id, SHA256_TAGS[VOLUMES_FILE], sha256(record.encode()))
    code, _, errors = answered(armscan, "evaluate", run_id)
    line = f"error: run {run_id}: its {VOLUMES_FILE}: is not a record of volumes and their fingerprints"
    assert (code, errors) == (2, line)


def test_run_with_a_class_of_ones_own_is_evaluated_with_trust(armscan, tmp_path):
    run_id = tracked(tmp_path, agent=GUESSER)
    code, _, errors = answered(armscan, "evaluate", run_id)
    assert code == 2
    assert "its configuration builds agent by 'tests.support.tracked_runs.Guesser'" in errors
    assert answered(armscan, "evaluate", run_id, "--trust")[0] == 0


@pytest.mark.parametrize(
    "word", ["agent._target_=os.getcwd", "+hydra.searchpath=[/tmp]", "tracking.uri=http://elsewhere"]
)
def test_grid_whose_command_line_names_code_is_not_resumed(tmp_path, word):
    run_id = grid_in(tmp_path, [word, "seed=1,2"])
    with pytest.raises(UntrustedError, match=re.escape(f"run {run_id}: its command line has {word!r}")):
        resume([f"resume={run_id}"])


def test_grid_of_another_folder_is_not_resumed(tmp_path, monkeypatch):
    run_id = grid_in(tmp_path, ["seed=1,2"])
    (tmp_path / "mine").mkdir()
    monkeypatch.chdir(tmp_path / "mine")
    with pytest.raises(UntrustedError, match=f"run {run_id}: it was started in {tmp_path}, whose configuration could"):
        resume([f"resume={run_id}"])
    assert resume([f"resume={run_id}", "--trust"]) == (["seed=1,2"], run_id, True)


@pytest.fixture
def elsewhere(monkeypatch):
    """Start a server of a stranger's; return its address and the headers of the requests that it got."""
    received = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            received.append(dict(self.headers))
            self.send_error(404)

        def do_PUT(self):
            self.do_GET()

        def log_message(self, *_):
            pass

    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "me")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "secret")
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/api/2.0/mlflow-artifacts/artifacts/0", received
        server.shutdown()


def test_server_that_a_run_names_for_its_artifacts_is_sent_nothing(armscan, tmp_path, elsewhere):
    uri, received = elsewhere
    run_id = tracked(tmp_path)
    (tmp_path / "theirs").mkdir()
    with contextlib.closing(sqlite3.connect(tmp_path / "mlruns.db")) as database, database:
        database.execute("UPDATE runs SET artifact_uri = ?", [f"{uri}/{run_id}/artifacts"])
    for name in ("evaluate", "export", "register"):
        code, _, errors = answered(armscan, name, run_id)
        assert (code, f"the artifacts are in {uri}" in errors) == (2, True)
    assert "they cannot be read" in armscan("runs", "show", run_id)[1]
    with pytest.raises(UntrustedError, match="the artifacts are in"):
        resume([f"resume={run_id}"])
    outbox = Outbox.begin(tmp_path / "theirs", Address(run_id, f"sqlite:///{tmp_path}/mlruns.db"))
    (tmp_path / "theirs/x.txt").touch()
    outbox.add(file=["x.txt", None])
    outbox.close()
    for trust in ([], ["--trust"]):
        assert f"the artifacts are in {uri}" in armscan("runs", "sync", "theirs", *trust)[1]
    assert received == []


def test_server_that_only_a_folder_names_is_sent_nothing(armscan, tmp_path, monkeypatch):
    uri = "postgresql://me@elsewhere/db"
    outbox = Outbox.begin(tmp_path / "theirs", Address("0" * 32, uri))
    outbox.add(tags={"a": "b"})
    outbox.close()
    opened = []
    monkeypatch.setattr("armscan.tracking.store._store", lambda uri, **_: opened.append(uri))
    code, printed, _ = armscan("runs", "sync", "theirs")
    assert code == 1
    assert f"{uri} is neither the default store nor one that a run of this user is pending in" in printed
    assert not opened
    # A stranger's outbox does not decide which stores are this user's.
    with contextlib.closing(Outbox(outbox.file)) as mine:
        mine.mark_pending("sqlite:///mlruns.db")
    assert (
        "is neither the default store nor one that a run of this user is pending in"
        in armscan("runs", "sync", "theirs")[1]
    )
    assert not opened


def grid_in(folder, words):
    """Track the parent of a grid that was started in a folder."""
    client, experiment_id = store_in(folder, "armscan")
    tags = {GRID_TAG: json.dumps(words), "working_folder": str(folder)}
    return client.create_run(experiment_id, name="grid", tags=tags).info.run_id


def test_code_in_a_kept_policy_is_not_executed_when_it_is_registered(armscan, tmp_path):
    run_id, model = registered(lambda *words: armscan("policy", *words), tmp_path)
    marker = tmp_path / "executed"
    code = model / CODE.name
    code.write_text(f"import pathlib\npathlib.Path({str(marker)!r}).touch()\n{code.read_text()}")
    store_of(tmp_path).set_tag(run_id, SUM_TAG, model_sha256(model))
    assert armscan("policy", "register", run_id, "--name=n")[0] == 0
    assert not marker.exists()


def test_commands_that_are_suggested_for_a_run_with_a_class_of_ones_own_can_be_typed(armscan, tmp_path):
    run_id = tracked(tmp_path, agent=GUESSER, kept=("config.yaml", "volumes.json"))
    client = store_of(tmp_path)
    client.log_param(run_id, "agent._target_", GUESSER["_target_"])
    (tmp_path / "best.pt").touch()
    client.log_artifact(run_id, str(tmp_path / "best.pt"))
    code, printed, _ = armscan("runs", "show", run_id)
    assert code == 0
    suggested = [line for line in printed.splitlines() if line.startswith(("evaluate", "record"))]
    assert len(suggested) == 2
    assert all(line.endswith(" --trust") for line in suggested)
    run_id = tracked(tmp_path)
    client.log_param(run_id, "agent._target_", "armscan.agents.SAC")
    code, printed, _ = armscan("runs", "show", run_id)
    assert code == 0
    assert f"armscan evaluate {run_id}\n" in printed
    assert "--trust" not in printed

"""The command that lists and prunes runs: on a server, beside a running run, and with invalid arguments."""

import json
import os
import re
import subprocess
import sys

import pytest
from mlflow import MlflowClient

from armscan.runs.prune import plan, remove, remove_planned
from armscan.runs.query import find_runs
from armscan.runs.run_folder import RunSkippedError
from armscan.tracking import open_store
from armscan.tracking.outbox import file_of
from armscan.utils.run_files import LOCK_FILE
from tests.support import FEW_VOLUMES, REPOSITORY
from tests.support.refusals import assert_refused


def test_runs_answers_mistakes_in_one_line(answer, make_run, tmp_path):
    run_id = make_run()
    for words, line in (
        (["remove"], "No such command 'remove'."),
        (["list", "--agnet=sac"], "No such option '--agnet'. (Did you mean one of: '--agent', '--parent'?)"),
        (["list", "runs"], "Got unexpected extra argument (runs)"),
        (["list", "--agent="], "Invalid value for '--agent': '' has an empty part."),
        (["list", "--format=xml"], "Invalid value for '--format': 'xml' is not one of 'table', 'csv', 'json'."),
        (["list", "--children=maybe"], "Option '--children' does not take a value."),
        (["list", "--since=soon"], "Invalid value for '--since': 'soon' is neither an age such as"),
        (["list", "--since=yesterday"], "Invalid value for '--since': 'yesterday' is neither an age such as 90m"),
        (["list", "--before=2026-02-30"], "Invalid value for '--before': '2026-02-30' is neither an age"),
        (["list", "--since=99999999999d"], "Invalid value for '--since': '99999999999d' is neither an age"),
        (["list", "--limit=few"], "Invalid value for '--limit': 'few' is not a valid integer"),
        (["list", "--limit=0"], "Invalid value for '--limit': 0 is not in the range x>=1."),
        (["list", "--status=done"], "Invalid value for '--status': 'done' is not finished, failed, killed or running."),
        (["list", "--sort=name"], "Invalid value for '--sort': 'name' is not one of 'started', '-started', 'duration'"),
        (["list", "--experiment=none"], "--experiment is 'none', but sqlite:///"),
        (["list", "--where=metrics > 3"], "--where is 'metrics > 3', but MLflow rejects this filter: "),
        (["list", "--where=a.b = 'c'"], "--where is \"a.b = 'c'\", but MLflow rejects this filter: "),
        (["list", "--parent=ffffffff"], "the run is 'ffffffff', but no run of sqlite:///"),
        (["list", "--tracking=sqlite:///no.db"], "tracking.uri is 'sqlite:///no.db', but there is no "),
        (
            ["list", "--tracking=http://127.0.0.1:9"],
            "tracking.uri is 'http://127.0.0.1:9', but this store cannot be",
        ),
        (["show"], "Missing argument 'RUN'."),
        (["show", "--run=3"], "No such option '--run'."),
        (["show", "xyz"], "the run is 'xyz', but it must be an ID as MLflow shows it"),
        (["show", run_id, "--agent=sac"], "No such option '--agent'."),
        (["prune"], "Missing argument '{checkpoints|folders}'. Choose from: checkpoints, folders"),
        (["prune", "all"], "Invalid value for '{checkpoints|folders}': 'all' is not one of 'checkpoints', "),
        (["prune", "folders", "--apply=yes please"], "Option '--apply' does not take a value."),
        (["prune", "folders", "--format=csv"], "No such option '--format'."),
    ):
        refused = answer(*words)
        assert refused[1] == "", words
        assert_refused(refused, line)
    assert (tmp_path / "outputs" / "tiny" / "best.pt").exists()


def test_runs_explains_itself(answer):
    code, printed, _ = answer("prune", "--help")
    assert code == 0
    assert "armscan runs prune checkpoints --before 30d" in printed


def resumed(folder, store, run_id, locked):
    locked(folder / LOCK_FILE)
    return "another process is using its folder"


def going_on_elsewhere(folder, store, run_id, locked):
    store[0].update_run(run_id, status="RUNNING")
    return "it is RUNNING, and could be resumed from there"


def taken_by_another(folder, store, run_id, locked):
    (folder / "config.yaml").write_text("name: another\n")
    return "holds another config.yaml than the run was started with"


def added_to(folder, store, run_id, locked):
    with file_of(folder, run_id).open("a") as outbox:
        outbox.write('{"tags": {"a": "b"}}\n')
    return "not all of it is uploaded"


def removed_by_another(folder, store, run_id, locked):
    store[0].delete_run(run_id)
    return "it has been deleted meanwhile"


@pytest.mark.parametrize("change", [resumed, going_on_elsewhere, taken_by_another, added_to, removed_by_another])
def test_run_is_left_that_somebody_has_begun_to_use_since_it_was_planned(store, make_run, locked, tmp_path, change):
    client, folder = store[0], tmp_path / "outputs" / "tiny"
    run_id = make_run()
    (case,) = plan(client, find_runs(client), "folders")
    assert case.left is None
    reason = change(folder, store, run_id, locked)
    with pytest.raises(RunSkippedError, match=reason):
        remove(client, case, "folders")
    assert (folder / "best.pt").exists()
    assert len(client.list_artifacts(run_id)) == 3


@pytest.mark.parametrize("what", ["checkpoints", "folders"])
def test_what_another_prune_has_removed_is_no_failure(store, make_run, capsys, tmp_path, what):
    run_id, client = make_run(), store[0]
    planned = plan(client, find_runs(client), "folders")
    for case in planned:
        remove(client, case, "folders")
    assert remove_planned(client, planned, what) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    folder = tmp_path / "outputs" / "tiny"
    assert f"{run_id} stays: its folder {folder} is gone\n" in printed.out
    assert not folder.exists()


@pytest.mark.full
def test_run_that_goes_on_ends_as_if_nothing_had_been_removed_beside_it(store, make_run, answer, tmp_path):
    old = make_run("old")
    words = ["agent=random", *FEW_VOLUMES, "evaluation.episodes=300"]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "armscan.run", *words],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    begun = ""
    while "playing 300 episodes" not in begun:
        begun += (line := process.stdout.readline())
        assert line, begun
    (going_on,) = re.findall("^run ([0-9a-f]{32}): ", begun, re.MULTILINE)
    code, printed, errors = answer("prune", "folders", "--apply")
    assert process.poll() is None, "it should still be going on"
    assert (code, errors) == (0, "")
    assert f"{old} removed" in printed
    assert f"{going_on} stays: it is RUNNING" in printed
    told, _ = process.communicate()
    assert process.returncode == 0, told
    client = MlflowClient(f"sqlite:///{tmp_path}/mlruns.db")
    run = client.get_run(going_on)
    assert run.info.status == "FINISHED"
    assert run.data.metrics["test_volumes/episodes"] == 300
    assert {"config.yaml", "evaluation.json", "episode.gif"} <= {file.path for file in client.list_artifacts(going_on)}


def test_runs_of_a_server_are_listed_and_removed(tracking_server, make_run, answer, tmp_path):
    uri = f"--tracking={tracking_server.uri}"
    opened = open_store(tracking_server.uri, experiment="pruned", artifacts="-", wait_s=60.0)
    run_id, kept = make_run("a", opened=opened), make_run("b", opened=opened)
    words = [uri, "--experiment=pruned"]
    rows = json.loads(answer("list", "--format=json", *words)[1])
    assert {row["run_id"] for row in rows} == {run_id, kept}
    files = list(tracking_server.artifacts.glob(f"*/{run_id}/artifacts/*"))
    assert rows[0]["artifact_bytes"] == sum(file.stat().st_size for file in files) > 3000
    assert "artifacts in mlflow-artifacts:/" in answer("show", run_id, uri)[1]
    one = f"--where=attributes.run_id = '{run_id}'"
    assert "folders of 1 of 1 runs would be removed" in answer("prune", "folders", one, *words)[1]
    assert all(file.exists() for file in files)
    code, _, errors = answer("prune", "folders", "--apply", one, *words)
    assert (code, errors) == (0, "")
    assert all(file.exists() for file in files)
    assert not (tmp_path / "outputs" / "a").exists()
    assert {row["run_id"] for row in json.loads(answer("list", "--format=json", *words)[1])} == {run_id, kept}
    assert (tmp_path / "outputs" / "b" / "best.pt").exists()

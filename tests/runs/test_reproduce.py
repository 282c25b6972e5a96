"""The command that reproduces a run, as a user types it, on a real tracked run."""

import contextlib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest

import armscan
from armscan.cli.main import main
from armscan.tracking.environment import environment
from armscan.tracking.git import code_state
from armscan.tracking.tags import EVALUATED_TAG
from tests.test_run import SMALL, armscan_run, runs_in

# They repeat a training.
pytestmark = pytest.mark.full

METRIC, STEP = "validation/mean_steps", 208


@pytest.fixture(scope="module")
def made(tmp_path_factory, data_folder):
    """Return a folder with volumes, which the configuration names relative to it, and a finished run."""
    folder = tmp_path_factory.mktemp("made")
    shutil.copytree(data_folder, folder / "volumes")
    words = [word for word in SMALL if not word.startswith("data.")]
    ended = armscan_run(*words, "seed=3", "data=nifti", "data.path=volumes", cwd=folder)
    assert ended.returncode == 0, ended.stderr
    client, (run,) = runs_in(folder)
    return folder, client, run


@pytest.fixture
def answer(made, tmp_path, monkeypatch, capsys):
    """Run the command in this process, elsewhere; return its exit code and what it printed."""
    folder = made[0]

    def command(*words):
        monkeypatch.chdir(tmp_path)
        before = len(runs_in(folder)[1])
        code = main(["runs", "reproduce", *words, f"--tracking=sqlite:///{folder}/mlruns.db"])
        printed = capsys.readouterr()
        if code == 2:
            assert len(runs_in(folder)[1]) == before
            assert not any(tmp_path.iterdir())
        return code, printed.out, printed.err.strip()

    return command


@contextlib.contextmanager
def written_otherwise(file, contents):
    """Replace the text of a file within a block."""
    before = file.read_bytes()
    file.write_bytes(contents)
    try:
        yield
    finally:
        file.write_bytes(before)


@contextlib.contextmanager
def tagged(client, run, name, value):
    """Replace a tag of a run within a block."""
    before = run.data.tags.get(name)
    client.set_tag(run.info.run_id, name, value)
    try:
        yield
    finally:
        if before is None:
            client.delete_tag(run.info.run_id, name)
        else:
            client.set_tag(run.info.run_id, name, before)


def test_reproduce_makes_the_same_again_and_tells_when_a_figure_was_another(made, tmp_path):
    folder, client, run = made
    # As in a training of a study's selection, which a reproduction is not.
    client.log_metric(run.info.run_id, "selection/mean_steps", 3.0)
    command = [
        sys.executable,
        "-m",
        "armscan",
        *("runs", "reproduce"),
        run.info.run_id[:8],
        f"--tracking=sqlite:///{folder}/mlruns.db",
    ]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.stderr == ""
    assert ended.returncode == 0, ended.stdout
    assert "code, packages, machine and volumes are unchanged" in ended.stdout
    (again,) = [each for each in runs_in(folder)[1] if each.info.run_id != run.info.run_id]
    assert again.data.tags["reproduction.of"] == run.info.run_id
    assert again.data.tags["reproduction.is_same"] == "true"
    assert again.data.tags["config.sha256"] != ""
    assert again.data.metrics.keys() >= {METRIC, "test_volumes/success_rate", "update/critic_loss"}
    (file,) = tmp_path.glob("reproductions/*/reproduction.json")
    facts = json.loads(file.read_text())
    assert (facts["of"], facts["run"], facts["is_same"]) == (run.info.run_id, again.info.run_id, True)
    assert {row["metric"] for row in facts["metrics"]} >= {METRIC, "test_volumes/success_rate"}
    assert not [row["metric"] for row in facts["metrics"] if row["metric"].startswith(("system/", "speed/", "wall"))]
    n_points = sum(row["n_points"] for row in facts["metrics"])
    assert f"the same: {n_points} points of {len(facts['metrics'])} metrics, to the last bit" in ended.stdout
    assert "reproduction.json" in {each.path for each in client.list_artifacts(again.info.run_id)}


def test_reproduce_says_by_how_much_a_metric_differs(made, answer, tmp_path):
    _, client, run = made
    point = client.get_metric_history(run.info.run_id, METRIC)[0]
    client.log_metric(run.info.run_id, METRIC, point.value + 2, step=point.step, timestamp=point.timestamp + 1)
    code, printed, errors = answer(run.info.run_id[:8], "--out=again")
    assert (code, errors) == (1, "")
    assert "not the same: 1 of" in printed
    assert f"{METRIC}: by 2 (" in printed
    assert f"at step {point.step}, where {point.value + 2:.6g} became {point.value:.6g}" in printed
    assert json.loads((tmp_path / "again" / "reproduction.json").read_text())["is_same"] is False


def test_reproduce_lists_what_differs_and_runs_nothing_where_it_is_not_to(made, answer, tmp_path):
    _, client, run = made
    assert answer(run.info.run_id, "--dry-run")[0] == 0
    kept = Path(urlsplit(run.info.artifact_uri).path) / "environment.json"
    other = json.loads(kept.read_text())
    other["packages"] |= {"torch": "1.0", "pytest": "1.0"}
    other["python"] = "2.7"
    with (
        tagged(client, run, "git.commit", "0" * 40),
        tagged(client, run, "constraints.sha256", "1" * 64),
        tagged(client, run, "git.diff.sha256", "2" * 64),
        written_otherwise(kept, json.dumps(other).encode()),
    ):
        code, printed, errors = answer(run.info.run_id, "--dry-run")
    assert (code, errors) == (1, "")
    assert f"differs: the git commit was {'0' * 40}, and is {code_state().commit}" in printed
    assert f"differs: the SHA-256 of constraints.txt was {'1' * 64}, and is" in printed
    assert "differs: changes since the commit had the SHA-256 22222222, and" in printed
    assert f"differs: python was 2.7, and is {environment()['python']}" in printed
    assert f"differs: torch was 1.0, and is {environment()['packages']['torch']}" in printed
    assert "differs: other packages whose versions differ, or that only one has: pytest" in printed
    assert not any(tmp_path.iterdir())


def test_reproduce_refuses_other_volumes(made, answer):
    folder, _, run = made
    one, other = (folder / "volumes" / f"0000{number}_labels.nii.gz" for number in (1, 3))
    manifest = folder / "volumes" / "optimal_actions.json"
    planes = json.loads(manifest.read_text())
    planes[one.name]["translation"][1] += 1.0
    with written_otherwise(manifest, json.dumps(planes).encode()):
        code, _, errors = answer(run.info.run_id)
    assert code == 2
    assert f"{one.name} is changed" in errors
    assert f"those that run {run.info.run_id} was started with" in errors
    assert other.exists()


def test_reproduce_refuses_what_is_no_run_to_make_again(made, answer):
    _, client, run = made
    run_id = run.info.run_id
    kept = Path(urlsplit(run.info.artifact_uri).path) / "config.yaml"
    assert "but no run of sqlite" in answer("f" * 32)[2]
    assert "Missing argument 'RUN'." in answer()[2]
    assert f"Got unexpected extra argument ({run_id})" in answer(run_id, run_id)[2]
    assert "No such option '--seed'" in answer(run_id, "--seed=4")[2]
    assert "Option '--dry-run' does not take a value." in answer(run_id, "--dry-run=perhaps")[2]
    with tagged(client, run, "armscan.version", "99.0"):
        assert f"was made by armscan 99.0, but this is {armscan.__version__}" in answer(run_id)[2]
    with tagged(client, run, EVALUATED_TAG, "abc"):
        assert "is an evaluation, of abc" in answer(run_id)[2]
    with written_otherwise(kept, kept.read_bytes() + b"more: 1\n"):
        assert "its config.yaml is not the one that it was started with" in answer(run_id)[2]
    client.update_run(run_id, status="RUNNING")
    try:
        assert "has not ended (RUNNING)" in answer(run_id)[2]
    finally:
        client.set_terminated(run_id)


@pytest.mark.parametrize("contents", [b"", b"no JSON", b"[]", b"{}", b'{"packages": null}', b"\xff\xfe\x00"])
def test_reproduce_refuses_a_damaged_record_of_the_environment(made, answer, contents):
    _, _, run = made
    with written_otherwise(Path(urlsplit(run.info.artifact_uri).path) / "environment.json", contents):
        code, _, errors = answer(run.info.run_id, "--dry-run")
    assert (code, errors) == (2, f"error: run {run.info.run_id}: its environment.json is damaged, or another file")


def test_reproduce_leaves_nothing_where_artifacts_are_read_only(made, answer, made_read_only):
    folder, _, run = made
    with made_read_only(folder / "mlartifacts"):
        code, _, errors = answer(run.info.run_id)
    assert code == 2
    assert f"the artifacts of runs lie in {folder}/mlartifacts" in errors
    assert "no file can be written there: Read-only file system" in errors


def test_reproduce_refuses_a_run_whose_artifacts_are_gone(made, answer):
    folder, _, run = made
    moved = folder / "moved"
    artifacts = folder / "mlartifacts"
    (artifacts / run.info.run_id).rename(moved)
    try:
        assert "has no config.yaml among its artifacts" in answer(run.info.run_id)[2]
    finally:
        moved.rename(artifacts / run.info.run_id)


def test_reproduce_writes_into_no_folder_that_holds_something(made, answer):
    folder, _, run = made
    code, _, errors = answer(run.info.run_id, f"--out={folder}")
    assert code == 2
    assert f"--out is {str(folder)!r}, but it exists and is not an empty folder" in errors

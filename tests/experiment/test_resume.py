"""Runs that are killed at any moment, and resumed: real processes, ended by `kill -9`."""

import contextlib
import json
import os
import random
import shutil
import signal
import sys
import time
from functools import partial
from pathlib import Path

import pytest

import armscan
from armscan.tracking.outbox import Address, Outbox
from armscan.tracking.run_end import begin_outbox
from armscan.tracking.tags import GRID_TAG
from armscan.training import load_checkpoint
from armscan.utils.files import sha256
from armscan.utils.run_files import CONFIG_FILE, LAST_CHECKPOINT, VOLUMES_FILE, folder_lock
from tests.support.killed_at import Moment, commands
from tests.support.processes import COMMAND, start_run
from tests.support.stores import store_in
from tests.support.tensors import assert_same_tensors
from tests.support.waiting import HANG_S, wait_until
from tests.test_run import SMALL, TIMES, armscan_run, job_process_ids, runs_in

LONGER = [*SMALL, "training.env_steps=1000", "training.solved=null"]
PPO = [*(each for each in LONGER if not each.startswith("agent.learning_starts")), "agent=ppo", "agent.num_envs=4"]
PPO += ["agent.env_steps_per_collection=100"]
IMAGES = [*(each for each in LONGER if not each.startswith("network")), "obs=slice_channels", "obs.shape=[36,36]"]
IMAGES += ["network=multimodal", "network.filters=[2,2,2]", "network.vector_sizes=[8]", "network.head_sizes=[8]"]
CHANGES = "{from_env_steps:300,agent.lr:0.01,agent.ent_coef_lr:0.01},{from_env_steps:700,agent.utd_ratio:0.5}"
SCHEDULED = [*LONGER, f"training.schedule=[{CHANGES}]"]
TWO = ("00001_labels.nii.gz", "00002_labels.nii.gz")
# The same, but every checkpoint stays unfinished for a while.
SLOWLY_WRITTEN = """
import sys, time, torch
save = torch.save
def save_slowly(contents, file):
    save(contents, file)
    file.flush()
    time.sleep(0.4)
torch.save = save_slowly
from armscan.run import main
sys.exit(main())
"""
SLOWLY = (sys.executable, "-c", SLOWLY_WRITTEN)


def killed(moment, *arguments, cwd, command=COMMAND):
    """Start the command, and kill it as soon as `moment` is true of what it has printed."""
    process, printed = start_run(*arguments, cwd=cwd, command=command), cwd / "printed"
    wait_until(lambda: moment(printed.read_text()), process=process, log=printed.read_text, poll_s=0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL


def after_epochs(n):
    return lambda printed: printed.count(" steps  on plane") >= n


def unfinished(folder):
    return list(folder.glob("outputs/*/*/.*.unfinished"))


def finish(run_id, cwd):
    ended = armscan_run(f"resume={run_id}", cwd=cwd)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    return ended.stdout


def figures(client, run):
    """Return the history of every metric except times, which no two runs share."""
    names = [name for name in run.data.metrics if not name.startswith(TIMES)]
    return {name: [(p.step, p.value) for p in client.get_metric_history(run.info.run_id, name)] for name in names}


def assert_ended_alike(cwd):
    """Check that the two runs of a store have the same metrics, none twice, and the same weights bit for bit."""
    client, runs = runs_in(cwd)
    assert [run.info.status for run in runs] == ["FINISHED"] * 2
    first, second = (figures(client, run) for run in runs)
    assert first == second
    assert len(first["validation/mean_return"]) >= 4
    for run in runs:
        for name in run.data.metrics:
            steps = [point.step for point in client.get_metric_history(run.info.run_id, name)]
            assert len(steps) == len(set(steps)), name
        wall_s = [point.value for point in client.get_metric_history(run.info.run_id, "wall_s")]
        assert wall_s == sorted(wall_s)
    folders = [Path(run.data.tags["folder"]) for run in runs]
    for file in ("best.pt", "last.pt"):
        assert_same_tensors(*(load_checkpoint(folder / file)[0] for folder in folders))
    artifacts = [{file.path for file in client.list_artifacts(run.info.run_id)} for run in runs]
    assert artifacts[0] == artifacts[1]
    assert not unfinished(cwd)


@pytest.mark.full
@pytest.mark.usefixtures("database")
def test_run_killed_while_it_writes_a_checkpoint_goes_on_and_ends_as_if_it_had_not_been(tmp_path):
    killed(lambda printed: after_epochs(1)(printed) and unfinished(tmp_path), *LONGER, cwd=tmp_path, command=SLOWLY)
    assert unfinished(tmp_path)
    (run,) = runs_in(tmp_path)[1]
    assert run.info.status == "RUNNING"
    printed = finish(run.info.run_id[:10], tmp_path)
    assert "of them taken" in printed
    assert printed.count(" steps  on plane") < 5
    assert len(list(tmp_path.glob("outputs/*/*"))) == 1
    assert armscan_run(*LONGER, cwd=tmp_path).returncode == 0
    assert_ended_alike(tmp_path)
    again = armscan_run(f"resume={run.info.run_id}", cwd=tmp_path)
    assert (again.returncode, again.stdout) == (2, "")
    assert again.stderr == f"error: run {run.info.run_id} has finished: there is nothing to resume\n"


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [LONGER, PPO, IMAGES, SCHEDULED], ids=["sac", "ppo", "images", "scheduled"])
def test_run_killed_again_and_again_ends_as_if_it_had_not_been(tmp_path, arguments):
    drawn = random.Random(7)

    def soon_after(begun):
        """Return a moment up to half a second after something was printed."""
        due_s = []

        def moment(printed):
            if begun(printed) and not due_s:
                due_s.append(time.monotonic() + drawn.uniform(0.0, 0.5))
            return due_s and time.monotonic() > due_s[0]

        return moment

    # First before there is a checkpoint, then twice after epochs, and once while a checkpoint is written.
    killed(lambda printed: "training for" in printed, *arguments, cwd=tmp_path)
    (run,) = runs_in(tmp_path)[1]
    word = f"resume={run.info.run_id}"
    for _ in range(2):
        killed(soon_after(after_epochs(1)), word, cwd=tmp_path)
    killed(lambda _: unfinished(tmp_path), word, cwd=tmp_path, command=SLOWLY)
    finish(run.info.run_id, tmp_path)
    assert runs_in(tmp_path)[1][0].data.tags["resumed"] == "4"
    assert armscan_run(*arguments, cwd=tmp_path).returncode == 0
    assert_ended_alike(tmp_path)


def moments(drawn):
    """Return twenty moments of one training, in the order in which it reaches them, each in its own process."""
    collecting, validating = "armscan.envs.vector_env:ArmscanVectorEnv.step", "armscan.training.episodes:step_each"
    updating = "armscan.agents.compiled_sac:CompiledSAC.update_repeatedly"
    soon = partial(drawn.uniform, 0.0, 0.01)
    return [
        # Before there is a checkpoint.
        Moment(collecting, drawn.randrange(1, 7)),
        Moment(collecting, drawn.randrange(7, 20), soon()),
        Moment(updating, drawn.randrange(1, 6)),
        Moment(updating, drawn.randrange(6, 12), soon()),
        Moment(validating),
        Moment("armscan.training.episodes:_result", drawn.randrange(1, 3), soon()),
        # While the first is written: before its contents, in the middle, after them, before and after its renaming.
        Moment("torch:save"),
        Moment("torch:save", 1, drawn.uniform(0.0, 0.003)),
        Moment("os:fsync", drawn.randrange(3, 5)),
        Moment("pathlib:Path.replace", 4),
        Moment("armscan.training.checkpoints:save_checkpoint", 1, 900.0),
        # After it is resumed, the best one is written again; then that of the next epoch.
        Moment("torch:save", 1, drawn.uniform(0.0, 0.003)),
        Moment("armscan.training.checkpoints:save_checkpoint", 2, 900.0),
        Moment(collecting, drawn.randrange(1, 13), soon()),
        # Between a checkpoint and its entry, and around the upload of an entry.
        Moment("armscan.tracking.run:TrackedRun.on_epoch"),
        Moment("armscan.tracking.run:TrackedRun.on_epoch", 1, 900.0),
        Moment("mlflow:MlflowClient.log_batch", drawn.randrange(1, 4), 900.0),
        Moment(updating, drawn.randrange(1, 12)),
        # After all learning.
        Moment("armscan.training.video:VideoRecorder.capture", 1, drawn.uniform(0.0, 0.05)),
        Moment("armscan.experiment.runner:keep_results", 1, drawn.uniform(0.0, 0.1)),
    ]


@pytest.mark.slow
def test_run_killed_at_twenty_moments_ends_with_the_same_weights_and_figures(tmp_path):
    with commands(tmp_path) as command:
        words = LONGER
        for moment in moments(random.Random(18)):
            assert command.run(words, moment) == -signal.SIGKILL, (moment, (tmp_path / "printed").read_text())
            words = [f"resume={runs_in(tmp_path)[1][0].info.run_id}"]
        assert command.run(words) == 0, (tmp_path / "printed").read_text()
        assert command.run(LONGER) == 0
    assert_ended_alike(tmp_path)


@pytest.mark.slow
def test_interrupted_run_says_how_to_go_on_and_only_one_process_may(tmp_path):
    process = start_run(*LONGER, "training.env_steps=5000", cwd=tmp_path)
    wait_until(lambda: (tmp_path / "printed").read_text().count(" steps  on plane") >= 2, process=process)
    (run,) = runs_in(tmp_path)[1]
    # Still running, and not finished before the other has started.
    process.send_signal(signal.SIGSTOP)
    beside = armscan_run(f"resume={run.info.run_id}", cwd=tmp_path)
    assert beside.returncode == 2
    assert "another process is using this folder" in beside.stderr
    assert len(beside.stderr.splitlines()) == 1
    process.send_signal(signal.SIGCONT)
    process.send_signal(signal.SIGINT)
    assert process.wait(HANG_S) == 130
    assert f"resume with: python -m armscan.run resume={run.info.run_id}\n" in (tmp_path / "printed").read_text()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    ended = armscan_run(f"resume={run.info.run_id}", f"tracking.uri=sqlite:///{tmp_path}/mlruns.db", cwd=elsewhere)
    assert ended.returncode == 0, ended.stderr
    assert not list(elsewhere.iterdir())
    (run,) = runs_in(tmp_path)[1]
    assert run.info.status == "FINISHED"
    assert "failure" not in run.data.tags


@pytest.mark.slow
def test_killed_job_of_a_multirun_is_resumed_by_its_own_id(tmp_path):
    words = ["-m", "seed=0,1", "hydra.launcher.n_jobs=2", *LONGER, "training.env_steps=2000"]
    process = start_run(*words, cwd=tmp_path)
    wait_until(lambda: (tmp_path / "printed").read_text().count("[0 seed=0] ") >= 4, process=process)
    os.kill(job_process_ids(process.pid)[0], signal.SIGKILL)
    assert process.wait(HANG_S) == 1
    output = (tmp_path / "printed").read_text()
    client, runs = runs_in(tmp_path)
    (child,) = [run for run in runs if run.info.status == "FAILED" and "folder" in run.data.tags]
    assert f"resume job {child.data.tags['job']} with: python -m armscan.run resume={child.info.run_id}" in output
    parent_id = child.data.tags["mlflow.parentRunId"]
    finish(child.info.run_id, tmp_path)
    child = client.get_run(child.info.run_id)
    assert (child.info.status, child.data.tags["mlflow.parentRunId"]) == ("FINISHED", parent_id)


@pytest.fixture
def cut_off(tmp_path, database):
    """Make a run that was cut off before anything was learned; return its client, ID and folder."""
    client, experiment_id = store_in(tmp_path, "armscan", artifacts="mlartifacts")
    folder = tmp_path / "outputs" / "run"
    folder.mkdir(parents=True)
    (folder / CONFIG_FILE).write_text("seed: 3\n")
    tags = {
        "folder": str(folder),
        "host": "elsewhere",
        "working_folder": str(tmp_path),
        "armscan.version": armscan.__version__,
        "config.sha256": "f3",
    }
    return client, client.create_run(experiment_id, name="cut off", tags=tags).info.run_id, folder


def refused(answer, *words):
    code, printed = answer(*words)
    assert code == 2
    assert len(printed.splitlines()) == 1
    return printed


@pytest.mark.parametrize("beside", ["seed=1", "-m", "--multirun", "--cfg=job", "tracking.experiment=x", "resume=b"])
def test_resume_takes_nothing_beside_it(answer, tmp_path, beside):
    assert ("'b'" if beside == "resume=b" else beside) in refused(answer, "resume=a", beside)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("uri", ["", "tracking.uri=sqlite:///other.db", "tracking.uri="])
def test_resume_names_a_store_that_is_not_there_and_makes_none(answer, tmp_path, uri):
    assert refused(answer, "resume=a", *([uri] if uri else [])).startswith("error: tracking.uri is ")
    assert not list(tmp_path.iterdir())


def test_resume_names_a_run_that_is_not_there(answer, cut_off):
    assert "but no run of " in refused(answer, f"resume={'0' * 31}")
    assert "must be an ID as MLflow shows it" in refused(answer, "resume=")
    assert "must be an ID as MLflow shows it" in refused(answer, "resume='; DROP TABLE runs")


def test_resume_refuses_a_configuration_that_was_changed(answer, cut_off):
    _, run_id, folder = cut_off
    assert f"{CONFIG_FILE}: is not the configuration that run {run_id} was started" in refused(
        answer, f"resume={run_id}"
    )
    (folder / CONFIG_FILE).unlink()
    assert f"{CONFIG_FILE}: the run's configuration cannot be read" in refused(answer, f"resume={run_id}")


def test_resume_refuses_a_run_whose_folder_is_gone(answer, cut_off):
    client, run_id, folder = cut_off
    client.set_tag(run_id, "folder", str(folder / "gone"))
    printed = refused(answer, f"resume={run_id}")
    assert f"its folder {folder / 'gone'} is not there; it last ran on the host elsewhere" in printed


def test_resume_refuses_a_run_that_names_the_folder_of_another(answer, cut_off):
    client, run_id, folder = cut_off
    mine = "0" * 32
    Outbox.begin(folder, Address(mine, client.uri)).close()
    assert f"cannot be resumed: {folder} is the folder of run {mine}" in refused(answer, f"resume={run_id}")


def test_resume_refuses_a_run_that_is_going_on(answer, cut_off):
    _, run_id, folder = cut_off
    with folder_lock(folder):
        assert f"{folder}: another process is using this folder" in refused(answer, f"resume={run_id}")


def test_resume_refuses_a_run_of_a_newer_version(answer, cut_off):
    client, run_id, _ = cut_off
    client.set_tag(run_id, "armscan.version", "99.1.0")
    assert f"was made by armscan 99.1.0, but this is {armscan.__version__}" in refused(answer, f"resume={run_id}")


@pytest.mark.parametrize(
    ("tag", "value", "line"),
    [
        ("armscan.version", "x", "its tag armscan.version is 'x', not a version"),
        ("config.sha256", None, "has no tag config.sha256"),
        ("working_folder", None, "has no tag working_folder"),
        ("working_folder", "/nowhere", "that folder cannot be entered (No such file or directory)"),
        ("working_folder", "a\0b", "that folder cannot be entered (embedded null byte)"),
        (GRID_TAG, "x", "its tag grid holds no overrides"),
        (GRID_TAG, "{}", "its tag grid holds no overrides"),
        (GRID_TAG, "[1]", "its tag grid holds no overrides"),
    ],
)
def test_resume_refuses_a_run_whose_tags_are_not_those_of_armscan(answer, cut_off, tag, value, line):
    client, run_id, folder = cut_off
    client.set_tag(run_id, "config.sha256", sha256((folder / CONFIG_FILE).read_bytes()))
    if value is None:
        client.delete_tag(run_id, tag)
    else:
        client.set_tag(run_id, tag, value)
    assert line in refused(answer, f"resume={run_id}")


def test_resume_refuses_a_grid_that_has_finished(answer, cut_off):
    client, run_id, _ = cut_off
    client.set_tag(run_id, GRID_TAG, "[]")
    client.set_terminated(run_id, "FINISHED")
    assert f"run {run_id} has finished: there is nothing to resume" in refused(answer, f"resume={run_id}")


def test_resume_refuses_a_grid_whose_launcher_is_alive(answer, cut_off, tmp_path):
    client, run_id, _ = cut_off
    client.set_tag(run_id, GRID_TAG, "[]")
    (tmp_path / "grid").mkdir()
    with contextlib.closing(begin_outbox(tmp_path / "grid", run_id, client.uri)):
        assert f"run {run_id} is still running, in process {os.getpid()}" in refused(answer, f"resume={run_id}")


def test_resume_refuses_a_grid_whose_jobs_would_be_tracked_elsewhere(answer, cut_off, tmp_path):
    client, run_id, _ = cut_off
    client.set_tag(run_id, GRID_TAG, json.dumps(["agent=random", "seed=0,-1", "tracking.uri='sqlite:///mlruns.db'"]))
    (tmp_path / "mlruns.db").rename(tmp_path / "lab.db")
    line = refused(answer, f"resume={run_id}", "tracking.uri=sqlite:///lab.db")
    assert f"run {run_id} was tracked in sqlite:///mlruns.db, where its jobs would be tracked again, and not in" in line
    assert not (tmp_path / "mlruns.db").exists()


def test_resume_refuses_a_run_of_something_else(answer, cut_off):
    client, run_id, _ = cut_off
    client.delete_tag(run_id, "folder")
    assert "it was not started by armscan run" in refused(answer, f"resume={run_id}")
    client.set_tag(run_id, "study", "mine")
    assert "belongs to the study mine: type its command again" in refused(answer, f"resume={run_id}")


def test_resume_refuses_a_checkpoint_that_is_damaged_or_gone_and_leaves_the_run_as_it_is(answer, tmp_path):
    assert answer(*SMALL)[0] == 0
    client, (run,) = runs_in(tmp_path)
    client.set_terminated(run.info.run_id, "KILLED")
    last = Path(run.data.tags["folder"]) / LAST_CHECKPOINT
    contents = last.read_bytes()
    last.write_bytes(contents[:-1])
    assert f"{last}: is damaged" in refused(answer, f"resume={run.info.run_id}")
    last.unlink()
    assert f"{last}: this checkpoint is gone, but run" in refused(answer, f"resume={run.info.run_id}")
    assert client.get_run(run.info.run_id).info.status == "KILLED"
    # A run that was killed when only closing was left: its metrics are logged already.
    last.write_bytes(contents)
    assert answer(f"resume={run.info.run_id}")[0] == 0
    assert client.get_run(run.info.run_id).info.status == "FINISHED"
    assert len(client.get_metric_history(run.info.run_id, "test_volumes/mean_steps")) == 1


def test_resume_refuses_other_volumes_where_there_is_no_checkpoint(answer, tmp_path, data_folder):
    shutil.copytree(data_folder, tmp_path / "wrists")
    few = [word for word in SMALL if not word.startswith(("agent.", "network", "data."))]
    assert answer("agent=random", "data=nifti", "data.path=wrists", f"data.test=[{TWO[0]}]", *few)[0] == 0
    client, (run,) = runs_in(tmp_path)
    client.set_terminated(run.info.run_id, "KILLED")
    word, record = f"resume={run.info.run_id}", Path(run.data.tags["folder"]) / VOLUMES_FILE
    kept = record.read_bytes()
    record.write_bytes(kept.replace(b"00001_labels", b"00009_labels"))
    assert f"{record}: is not the record of its volumes that run" in refused(answer, word)
    record.write_bytes(kept)
    # Two wrists, each with its plane, exchange their names, and with them the splits.
    manifest = tmp_path / "wrists" / "optimal_actions.json"
    entries = json.loads(manifest.read_text())
    for name, other in (TWO, TWO[::-1]):
        shutil.copy(data_folder / name, tmp_path / "wrists" / other)
    manifest.write_text(json.dumps(entries | {TWO[0]: entries[TWO[1]], TWO[1]: entries[TWO[0]]}))
    line = f"volumes are not those that run {run.info.run_id} was started with: "
    assert line in refused(answer, word)
    assert client.get_run(run.info.run_id).info.status == "KILLED"


PARTS = """
import numpy as np
from gymnasium import spaces

SCALE = 100


class Nerve:
    def spaces(self, geometries, n_action):
        return {"nerve": spaces.Box(0.0, np.inf, (1,), np.float32)}

    def observe(self, view):
        return {"nerve": np.array([(view.slice_xz == 4).sum() / SCALE], dtype=np.float32)}
"""


def test_own_class_is_that_of_the_runs_folder_and_must_be_unchanged(tmp_path):
    own, elsewhere = tmp_path / "own", tmp_path / "elsewhere"
    for folder, text in ((own, PARTS), (elsewhere, PARTS.replace("100", "7"))):
        folder.mkdir()
        (folder / "parts_of_a_run.py").write_text(text)
    (own / "conf" / "obs").mkdir(parents=True)
    (own / "conf" / "obs" / "nerve.yaml").write_text("_target_: parts_of_a_run.Nerve\n")
    killed(lambda printed: "training for at most" in printed, *LONGER, "obs=nerve", cwd=own)
    (run,) = runs_in(own)[1]
    run_id = run.info.run_id
    again = ["resume=" + run_id, "--trust", f"tracking.uri=sqlite:///{own}/mlruns.db"]
    (own / "parts_of_a_run.py").write_text(PARTS.replace("100", "7"))
    refused = armscan_run(*again, cwd=elsewhere)
    assert refused.returncode == 2
    line = f"error: run {run_id} was started with other code of parts_of_a_run: put it back, or start another run"
    assert line in refused.stderr
    (own / "parts_of_a_run.py").write_text(PARTS)
    assert armscan_run(*again, cwd=elsewhere).returncode == 0

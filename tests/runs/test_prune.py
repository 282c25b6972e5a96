"""Rules of prune, each on a run that would be removed without it."""

import errno
import json
import shutil
import sqlite3
from pathlib import Path

import pytest

from armscan.tracking.outbox import file_of
from armscan.tracking.pending_runs import PENDING_FOLDER
from armscan.utils.run_files import LOCK_FILE


def ids_in(folder):
    """Return the IDs of the active runs of a database."""
    with sqlite3.connect(folder / "mlruns.db") as database:
        found = database.execute("select run_uuid from runs where lifecycle_stage = 'active'")
        return {run_id for (run_id,) in found}


def artifacts_of(folder, run_id):
    return sorted(file.name for file in (folder / "mlartifacts").glob(f"{run_id}/artifacts/*"))


def test_nothing_is_touched_without_apply_and_the_command_that_does_it_is_told(answer, make_run, snapshot, tmp_path):
    run_id = make_run()
    before = snapshot(), ids_in(tmp_path)
    for what in ("checkpoints", "folders"):
        code, printed, errors = answer("prune", what, "--before=2100-01-01")
        assert (code, errors) == (0, "")
        assert run_id[:8] in printed
        assert f"{what} of 1 of 1 runs would be removed" in printed
        assert f"remove it armscan runs prune {what} --before=2100-01-01 --apply\n" in printed
    assert (snapshot(), ids_in(tmp_path)) == before


def test_pruning_checkpoints_leaves_everything_else(answer, make_run, snapshot, tmp_path):
    run_id = make_run()
    before = snapshot()
    code, printed, _ = answer("prune", "checkpoints", "--apply")
    assert code == 0
    assert f"{run_id} removed, 3.0 kB\n" in printed
    gone = {file.relative_to(tmp_path).as_posix() for file in before.keys() - snapshot().keys()}
    assert gone == {"outputs/tiny/best.pt", "outputs/tiny/last.pt"}
    assert artifacts_of(tmp_path, run_id) == ["best.pt", "config.yaml", "last.pt"]
    code, printed, _ = answer("prune", "checkpoints")
    assert f"{run_id[:8]} stays: its folder holds no checkpoint of it" in printed


def test_pruning_folders_leaves_the_store(answer, make_run, tmp_path):
    run_id = make_run()
    assert answer("prune", "folders", "--apply")[0] == 0
    assert not (tmp_path / "outputs" / "tiny").exists()
    assert (ids_in(tmp_path), len(artifacts_of(tmp_path, run_id))) == ({run_id}, 3)


def test_run_of_a_trial_which_has_no_files_is_not_listed(answer, make_run, store, tmp_path):
    client, experiment_id = store
    run_id = make_run()
    trial = client.create_run(experiment_id, name="trial 3", tags={"trial": "3", "folder": str(tmp_path)}).info.run_id
    printed = answer("prune", "folders")[1]
    assert run_id[:8] in printed
    assert trial[:8] not in printed
    assert "folders of 1 of 1 runs would be removed" in printed


def kept_files():
    """Return the checkpoints and configurations below the folder that the command is in, with their contents."""
    return {file: file.read_bytes() for file in Path.cwd().rglob("*") if file.suffix in (".pt", ".yaml")}


def assert_stays(answer, run_id, reason, what):
    """Check that a run is left with a reason, in the dry run and with --apply, and that this is no failure."""
    planned = answer("prune", what)[1]
    kept = kept_files()
    assert f"{run_id[:8]} stays: {reason}" in planned, planned
    code, printed, errors = answer("prune", what, "--apply")
    assert (code, errors) == (0, "")
    assert f"{run_id} stays: {reason}" in printed
    assert f"{what} of 0 of " in printed
    assert run_id in answer("list", "--children", "--format=csv")[1]
    assert kept_files() == kept


WHAT = pytest.mark.parametrize("what", ["checkpoints", "folders"])


@WHAT
def test_folder_that_another_process_holds_is_left(answer, make_run, locked, snapshot, tmp_path, what):
    run_id = make_run()
    before = snapshot()
    locked(tmp_path / "outputs" / "tiny" / LOCK_FILE)
    assert_stays(answer, run_id, "another process is using its folder", what)
    assert snapshot().keys() - before.keys() == {tmp_path / "outputs" / "tiny" / LOCK_FILE}
    assert ids_in(tmp_path) == {run_id}


@WHAT
def test_outbox_that_another_process_holds_is_left(answer, make_run, locked, tmp_path, what):
    run_id = make_run()
    locked(file_of(tmp_path / "outputs" / "tiny", run_id).with_suffix(".lock"))
    assert_stays(answer, run_id, "another process is using its folder", what)


@WHAT
def test_what_is_not_uploaded_is_left(answer, make_run, tmp_path, what):
    run_id = make_run()
    with file_of(tmp_path / "outputs" / "tiny", run_id).open("a") as outbox:
        outbox.write('{"tags": {"a": "b"}}\n')
    folder = tmp_path / "outputs" / "tiny"
    assert_stays(answer, run_id, f"not all of it is uploaded: run armscan runs sync {folder}", what)


@WHAT
def test_damaged_outbox_is_left(answer, make_run, tmp_path, what):
    run_id = make_run()
    file_of(tmp_path / "outputs" / "tiny", run_id).write_text("no entry\n")
    assert_stays(answer, run_id, "the outbox in its folder cannot be read: ", what)


@WHAT
def test_run_of_a_newer_armscan_is_listed_and_shown_and_left(answer, make_run, what):
    run_id = make_run(tags={"armscan.version": "99.1.0"})
    assert_stays(answer, run_id, f"run {run_id} was made by armscan 99.1.0, but this is ", what)
    assert run_id[:8] in answer("list")[1]
    assert "99.1.0" in answer("show", run_id)[1]


@WHAT
def test_children_of_a_parent_that_is_running_are_left(answer, make_run, store, what):
    client, experiment_id = store
    parent_id = client.create_run(experiment_id, name="study", tags={}).info.run_id
    run_id = make_run(parent_id=parent_id)
    assert_stays(answer, run_id, f"its parent, run {parent_id}, is RUNNING", what)
    client.set_terminated(parent_id, "FINISHED")
    assert "1 of 2 runs" in answer("prune", what)[1]


@WHAT
def test_seeds_of_a_finished_trial_of_a_study_that_is_running_are_left(answer, make_run, store, what):
    client, experiment_id = store
    study_id, trial_id = (client.create_run(experiment_id, name=name, tags={}).info.run_id for name in "ab")
    client.set_tag(trial_id, "mlflow.parentRunId", study_id)
    client.set_terminated(trial_id, "FINISHED")
    run_id = make_run(parent_id=trial_id)
    assert_stays(answer, run_id, f"its study, run {study_id}, is RUNNING", what)
    client.set_terminated(study_id, "FINISHED")
    assert "1 of 3 runs" in answer("prune", what)[1]


@WHAT
def test_run_that_could_go_on_keeps_its_folder(answer, make_run, store, what):
    run_id = make_run()
    store[0].update_run(run_id, status="RUNNING")
    assert_stays(answer, run_id, "it is RUNNING, and could be resumed from there", what)


def another_host(folder, make_run):
    return make_run(tags={"host": "another"}), f"its folder {folder} is on the host another"


def no_host(folder, make_run):
    run_id = make_run()
    with sqlite3.connect(folder.parent.parent / "mlruns.db") as database:
        database.execute("delete from tags where key = 'host'")
    return run_id, f"its folder {folder} was noted without its host"


def another_config(folder, make_run):
    run_id = make_run()
    (folder / "config.yaml").write_text("name: changed\n")
    return run_id, f"{folder} holds another config.yaml than the run was started with"


def no_config(folder, make_run):
    run_id = make_run()
    (folder / "config.yaml").unlink()
    return run_id, f"{folder} has no config.yaml, so it may not be the run's"


def a_link_above(folder, make_run):
    run_id = make_run()
    folder.parent.rename(folder.parent.with_name("moved"))
    folder.parent.symlink_to("moved")
    return run_id, f"its folder {folder} is reached through a link"


def anothers_outbox(folder, make_run):
    run_id = make_run()
    shutil.copy(file_of(folder, run_id), file_of(folder, 32 * "f"))
    return run_id, f"{folder} is the folder of run {32 * 'f'}, too"


def relative(folder, make_run):
    return make_run(tags={"folder": "outputs/tiny"}), "its folder is 'outputs/tiny', which is not an absolute path"


@pytest.mark.parametrize(
    "change", [another_host, no_host, another_config, no_config, a_link_above, anothers_outbox, relative]
)
@WHAT
def test_folder_that_is_not_certainly_the_runs_is_left_and_said_so(answer, make_run, tmp_path, change, what):
    run_id, reason = change(tmp_path / "outputs" / "tiny", make_run)
    assert_stays(answer, run_id, reason, what)


def test_folder_of_two_runs_is_left(answer, make_run, tmp_path):
    folder = tmp_path / "shared"
    first, second = make_run(folder=folder), make_run(folder=folder)
    # As in earlier versions, which had no outboxes.
    shutil.rmtree(folder / "tracking")
    assert_stays(answer, first, f"{folder} is the folder of run {second}, too", "folders")
    assert (folder / "best.pt").exists()


def test_files_of_others_and_what_links_lead_to_are_left(answer, make_run, tmp_path):
    folder = tmp_path / "outputs" / "tiny"
    run_id = make_run()
    (tmp_path / "precious").write_text("precious")
    (folder / "mine.txt").write_text("mine")
    (folder / "best.pt").unlink()
    (folder / "best.pt").symlink_to(tmp_path / "precious")
    with file_of(folder, run_id).open("a") as outbox:
        outbox.write('{"file": "../../precious"}\n')
    assert answer("prune", "folders", "--apply")[1].count("not all of it is uploaded") == 1
    file_of(folder, run_id).with_suffix(".delivered.json").write_text(
        '{{"files": {0}, "figures": {0}}}'.format(file_of(folder, run_id).stat().st_size)
    )
    code, printed, _ = answer("prune", "folders", "--apply")
    assert code == 0
    assert f"{folder} stays, with what is not the run's" in printed
    assert {file.name for file in folder.iterdir()} == {"best.pt", "mine.txt"}
    assert (tmp_path / "precious").read_text() == "precious"


def test_run_that_cannot_be_removed_is_one_line_and_the_rest_goes_on(answer, make_run, monkeypatch, tmp_path):
    stuck, other = make_run("stuck"), make_run("other")
    unlink = Path.unlink

    def refused(file, **options):
        if file == tmp_path / "outputs" / "stuck" / "last.pt":
            raise PermissionError(errno.EACCES, "Permission denied", str(file))
        unlink(file, **options)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", refused)
        code, printed, errors = answer("prune", "folders", "--apply")
    assert code == 1
    assert f"{other} removed" in printed
    assert errors == f"{stuck} is not removed: {tmp_path}/outputs/stuck/last.pt: Permission denied"
    # It is still there, and can be tried again.
    assert answer("prune", "folders", "--apply")[0] == 0
    assert not (tmp_path / "outputs" / "stuck").exists()


@WHAT
def test_folder_that_may_not_be_written_is_left(answer, make_run, made_read_only, tmp_path, what):
    run_id = make_run()
    with made_read_only(tmp_path / "outputs" / "tiny"):
        assert_stays(answer, run_id, "it is unknown whether another process is using its folder", what)


def test_file_of_somebody_else_that_an_earlier_version_has_tracked_stays(answer, make_run, tmp_path):
    folder = tmp_path / "outputs" / "tiny"
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("precious")
    make_run(also=["notes.txt"])
    code, printed, _ = answer("prune", "folders", "--apply")
    assert code == 0
    assert f"{folder} stays, with what is not the run's" in printed
    assert [file.name for file in folder.iterdir()] == ["notes.txt"]


def test_policy_is_counted_and_goes_with_its_folder(answer, make_run, tmp_path):
    make_run(policy={"MLmodel": bytes(10_000), "artifacts/more/policy.pt2": bytes(20_000)})
    (row,) = json.loads(answer("list", "--format=json")[1])
    assert 33_000 < row["folder_bytes"] < 35_000
    assert answer("prune", "folders", "--apply")[0] == 0
    assert not (tmp_path / "outputs" / "tiny").exists()


def test_files_beside_a_policy_that_are_not_the_runs_stay(answer, make_run, tmp_path):
    make_run(policy={"MLmodel": b"m", "artifacts/policy.pt2": b"p"})
    mine = tmp_path / "outputs" / "tiny" / "policy" / "artifacts" / "mine.txt"
    mine.write_text("mine")
    assert answer("prune", "folders", "--apply")[0] == 0
    assert [file for file in (tmp_path / "outputs").rglob("*") if file.is_file()] == [mine]


def test_removal_that_is_interrupted_can_be_tried_again(answer, make_run, monkeypatch, tmp_path):
    make_run()
    unlink = Path.unlink

    def interrupted(file, **options):
        if file.name == "config.yaml":
            raise KeyboardInterrupt
        unlink(file, **options)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", interrupted)
        assert answer("prune", "folders", "--apply")[0] == 130
    assert not (tmp_path / "outputs" / "tiny" / "last.pt").exists()
    assert answer("prune", "folders", "--apply")[0] == 0
    assert not (tmp_path / "outputs" / "tiny").exists()


def test_run_that_somebody_has_deleted_stays_as_it_is(answer, make_run, store, tmp_path):
    deleted = make_run("deleted")
    store[0].delete_run(deleted)
    for what in ("checkpoints", "folders"):
        assert "0 of 0 runs" in answer("prune", what, "--apply")[1]
    assert (tmp_path / "outputs" / "deleted" / "best.pt").exists()
    assert len(artifacts_of(tmp_path, deleted)) == 3


def test_note_of_a_run_goes_with_its_folder(answer, make_run, monkeypatch, tmp_path):
    monkeypatch.setenv("ARMSCAN_CACHE", str(tmp_path / "cache"))
    run_id = make_run()
    # As left by a run whose rest was uploaded by `armscan runs sync`.
    pending = tmp_path / "cache" / PENDING_FOLDER / run_id
    pending.symlink_to(file_of(tmp_path / "outputs" / "tiny", run_id))
    assert answer("prune", "folders", "--apply")[0] == 0
    assert not pending.exists()

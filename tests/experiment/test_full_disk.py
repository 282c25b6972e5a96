"""Disks that are full under a run's folder, and under its tracking store."""

import re
import sqlite3
import subprocess
import sys

import pytest

from tests.experiment.test_resume import LONGER, after_epochs, assert_ended_alike, finish
from tests.support.processes import COMMAND
from tests.support.waiting import HANG_S, wait_until
from tests.test_run import SMALL, armscan_run, runs_in

pytestmark = pytest.mark.slow
FULL = "No space left on device"


def run_until_full(disk, *words, cwd):
    """Run the command, fill the disk after its first epoch; return exit code, standard output and standard error."""
    printed, told = cwd / "printed", cwd / "told"
    with printed.open("w") as output, told.open("w") as errors:
        process = subprocess.Popen([*COMMAND, *words], cwd=cwd, stdout=output, stderr=errors)
    wait_until(lambda: after_epochs(1)(printed.read_text()), process=process, log=told.read_text, poll_s=0.01)
    disk.fill()
    return process.wait(HANG_S), printed.read_text(), told.read_text()


def test_run_whose_folder_is_full_ends_in_one_line_and_goes_on_when_there_is_space(disk, tmp_path):
    code, _, told = run_until_full(disk, *LONGER, f"hydra.run.dir={disk.folder}/run", cwd=tmp_path)
    assert code == 2, told
    (run,) = runs_in(tmp_path)[1]
    hint, line = told.splitlines()
    assert hint == f"resume with: python -m armscan.run resume={run.info.run_id}"
    assert line.startswith(f"error: {disk.folder}/run")
    assert line.endswith(f": {FULL}")
    disk.empty()
    finish(run.info.run_id, tmp_path)
    assert armscan_run(*LONGER, cwd=tmp_path).returncode == 0
    assert_ended_alike(tmp_path)


def test_run_goes_on_while_the_disk_of_its_store_is_full_and_sync_uploads_the_rest(disk, tmp_path):
    words = [*LONGER, f"tracking.uri=sqlite:///{disk.folder}/mlruns.db", "tracking.wait_s=2"]
    code, printed, told = run_until_full(disk, *words, cwd=tmp_path)
    assert (code, told) == (0, "")
    assert "cannot be reached or written to" in printed
    assert "uploads the rest" in printed
    with sqlite3.connect(disk.folder / "mlruns.db") as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    refused = armscan_run(*LONGER, f"tracking.uri=sqlite:///{disk.folder}/other.db", cwd=tmp_path)
    assert refused.returncode == 2
    assert len(refused.stderr.splitlines()) == 1
    assert refused.stderr.startswith(f"error: tracking.uri is 'sqlite:///{disk.folder}/other.db', but ")
    disk.empty()
    synced = subprocess.run(
        [sys.executable, "-m", "armscan", "runs", "sync", "outputs"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert synced.returncode == 0, synced.stdout + synced.stderr
    assert armscan_run(*words, cwd=tmp_path).returncode == 0
    assert_ended_alike(disk.folder)


def test_grid_whose_folder_is_full_tells_the_cause_and_how_to_resume_it(disk, tmp_path):
    words = ["-m", "seed=1,2", *(each for each in LONGER if not each.startswith("seed="))]
    code, _, told = run_until_full(disk, *words, f"hydra.sweep.dir={disk.folder}/grid", cwd=tmp_path)
    assert code != 0
    assert "Traceback" not in told
    for label in ("0 seed=1", "1 seed=2"):
        assert f"[{label}] failed: {disk.folder}/grid" in told
    resumed = re.search(r"resume=[0-9a-f]{32}$", told)
    assert resumed is not None, told
    disk.empty()
    again = armscan_run(resumed[0], cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    # The new grid and both jobs; a job without a checkpoint has begun again as a new run.
    assert [run.info.status for run in runs_in(tmp_path)[1]].count("FINISHED") == 3


def test_grid_that_begins_on_a_full_disk_leaves_no_run(disk, tmp_path):
    disk.fill()
    refused = armscan_run("-m", "seed=1,2", *SMALL, f"hydra.sweep.dir={disk.folder}/grid", cwd=tmp_path)
    assert refused.returncode == 2
    assert refused.stderr.startswith(f"error: {disk.folder}/grid")
    assert refused.stderr.endswith(f": {FULL}\n")
    assert runs_in(tmp_path)[1] == []

"""Supervisors of workers, on machines that do not share what they must."""

import json

import pytest

from armscan.errors import StudyError
from armscan.sweeps.workers.supervisor import LAUNCHER_FILE, run_worker
from armscan.utils.processes import ProcessInfo


def test_worker_on_a_machine_that_does_not_share_the_folder_of_the_study_says_so(tmp_path):
    with pytest.raises(StudyError, match=f"{tmp_path} of the machine that the study was started on cannot be seen"):
        run_worker([], 0, tmp_path)


def test_worker_on_a_machine_that_does_not_share_the_directory_of_the_command_says_so(tmp_path):
    launcher = ProcessInfo("elsewhere", 1, "1", "/nowhere")
    launcher.write(tmp_path / LAUNCHER_FILE)
    assert json.loads((tmp_path / LAUNCHER_FILE).read_text())["directory"] == "/nowhere"
    with pytest.raises(StudyError, match="/nowhere of the machine that the study was started on cannot be seen from "):
        run_worker([], 0, tmp_path)

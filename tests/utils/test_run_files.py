"""Folders of runs, each locked by one process."""

import subprocess
import sys

import pytest

from armscan.errors import FolderInUseError
from armscan.utils.run_files import folder_lock


def test_folder_is_free_again_when_its_process_was_killed(tmp_path):
    program = (
        "import sys, time; from pathlib import Path; from armscan.utils.run_files import folder_lock\n"
        "with folder_lock(Path(sys.argv[1])): print('held', flush=True); time.sleep(900)"
    )
    process = subprocess.Popen([sys.executable, "-c", program, tmp_path], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    with pytest.raises(FolderInUseError, match="another process"), folder_lock(tmp_path):
        pass
    process.kill()
    process.wait()
    with folder_lock(tmp_path):
        pass

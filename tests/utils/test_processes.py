"""Processes that armscan starts."""

import gc
import subprocess
from pathlib import Path

from armscan.utils.processes import child_command, no_garbage_collection

ROOT = Path(__file__).parents[2]


def print_threshold():
    print("threshold", gc.get_threshold()[0])


def test_child_runs_its_function_and_collects_garbage_rarely():
    command = child_command("tests.utils.test_processes", print_threshold.__name__)
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert ended.stdout == "threshold 50000\n"


def test_child_that_is_interrupted_while_it_imports_ends_as_interrupted(tmp_path):
    (tmp_path / "slow_import.py").write_text("raise KeyboardInterrupt\n")
    ended = subprocess.run(child_command("slow_import", "run"), cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 130
    assert not ended.stderr


def test_objects_made_without_garbage_collection_are_never_looked_through_again():
    try:
        with no_garbage_collection():
            assert not gc.isenabled()
        assert gc.isenabled()
        assert gc.get_freeze_count() > 0
    finally:
        gc.unfreeze()

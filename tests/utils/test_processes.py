"""Processes that armscan starts."""

import gc
import itertools
import os
import subprocess
import threading

import psutil
import pytest

from armscan.utils.processes import (
    child_command,
    n_usable_cores,
    no_garbage_collection,
    on_parent_exit,
    process_start,
)
from tests.support import REPOSITORY


def print_threshold(parent_pid):
    print("threshold", gc.get_threshold()[0], "parent", parent_pid)


def test_child_runs_its_function_and_collects_garbage_rarely():
    command = child_command("tests.utils.test_processes", print_threshold.__name__)
    ended = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert ended.stdout == f"threshold 50000 parent {os.getpid()}\n"


def test_child_whose_parent_ended_while_it_imported_is_told_so():
    told = threading.Event()
    # Not this process's parent, as if that had ended and another process had adopted this one.
    on_parent_exit(os.getppid() + 1, told.set)
    assert told.wait(10.0)


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


def test_cores_are_counted_where_there_is_no_affinity(monkeypatch):
    assert n_usable_cores() == len(os.sched_getaffinity(0))
    monkeypatch.delattr(os, "sched_getaffinity")
    assert n_usable_cores() == os.cpu_count()


def test_start_of_a_process_does_not_move_with_the_clock(monkeypatch):
    started = process_start(os.getpid())
    assert float(started) > 0.0
    # As after the clock was set, between any two calls.
    monkeypatch.setattr(psutil, "boot_time", itertools.count(1.0).__next__)
    assert process_start(os.getpid()) == started


@pytest.mark.parametrize("pid", [2**22 + 1, -1, None, "1x"])
def test_what_is_no_process_has_no_start(pid):
    assert process_start(pid) == ""

"""Start the studies of the benchmarks, and read their results."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import optuna
from optuna.trial import FrozenTrial

from armscan.sweeps.scheduling.state import StudyState
from armscan.sweeps.storage.attribute_names import LEASE
from armscan.sweeps.storage.storage import open_storage
from benchmarks.repository import environment

N_WORKERS = 4
NAME, JOURNAL = "benchmark", "optuna.journal"
# Overrides of every study here.
WITHOUT_FINAL_EVAL = ("study.final_eval.top_k=0",)
SLEEPING = (
    *("study.task._target_=benchmarks.sweeps.sleeping.Sleeping", "study/sampler=random", "study/pruner=none"),
    *(f"study.workers={N_WORKERS}", "+study.space={agent.lr:{low:1.0e-4,high:1.0e-2,log:true}}"),
)
# Pretends to have 64 cores: a trial that only waits needs none.
PROGRAM = """
import os, sys
os.sched_getaffinity = lambda _: range(64)
from armscan.run import main
sys.exit(main())
"""


def started(
    folder: Path, *words: str, sweep: str = "sac_y", name: str = NAME, python: Sequence[str] = ("-c", PROGRAM)
) -> subprocess.Popen[bytes]:
    """Start a study in a folder, without final evaluation.

    Args:
        folder: Folder of the study; what it prints goes to `NAME.log` there.
        *words: Further overrides.
        sweep: Name of the sweep. Default: `sac_y`.
        name: Name of the study. Default: `benchmark`.
        python: Python's words for the command. Default: those of `PROGRAM`.
    """
    words = ("-m", f"sweep={sweep}", f"study.name={name}", *WITHOUT_FINAL_EVAL, *words)
    with (folder / f"{name}.log").open("ab") as log:
        command = [sys.executable, *python, *words]
        return subprocess.Popen(command, cwd=folder, env=environment(), stdout=log, stderr=log)


def run_study(folder: Path, sweep: str, name: str, *words: str) -> optuna.Study:
    """Run a study without final evaluation to its end, or resume it, and return it.

    Args:
        folder: Folder of the study, created if missing.
        sweep: Name of the sweep.
        name: Name of the study, and of its log.
        *words: Further overrides.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _wait_for(started(folder, *words, sweep=sweep, name=name, python=("-m", "armscan.run")), folder / f"{name}.log")
    return optuna.load_study(study_name=name, storage=open_storage(str(folder / JOURNAL)).optuna)


def finish(folder: Path, *words: str) -> StudyState:
    """Run a study in a folder to its end, and return its state."""
    _wait_for(started(folder, *words), folder / f"{NAME}.log")
    return state_in(folder)


def _wait_for(process: subprocess.Popen[bytes], log: Path) -> None:
    if process.wait() != 0:
        sys.exit(log.read_text())


def state_in(folder: Path, uri: str = JOURNAL) -> StudyState:
    """Return the state of the study in a folder."""
    storage = open_storage(uri if "://" in uri else str(folder / uri))
    study = storage.study(NAME)
    return StudyState.of([] if study is None else study.trials)


def by_worker(state: StudyState) -> dict[str, list[FrozenTrial]]:
    """Return the finished trials of each worker, in order of their start."""
    workers: dict[str, list[FrozenTrial]] = {}
    for trial in sorted(state.finished, key=lambda trial: trial.datetime_start):
        workers.setdefault(trial.user_attrs[LEASE]["worker"], []).append(trial)
    return workers

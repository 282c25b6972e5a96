"""Start the studies of the benchmarks, and read their results."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import optuna
from optuna.trial import FrozenTrial

from armscan.sweeps.scheduling.state import StudyState
from armscan.sweeps.storage.attribute_names import LEASE
from armscan.sweeps.storage.storage import open_storage

N_WORKERS = 4
NAME, JOURNAL = "benchmark", "optuna.journal"
REPOSITORY = Path(__file__).parents[2]
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


def started(folder: Path, *words: str) -> subprocess.Popen[bytes]:
    """Start a study in a folder, without final evaluation."""
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    words = ("-m", "sweep=sac_y", f"study.name={NAME}", *WITHOUT_FINAL_EVAL, *words)
    with (folder / "printed").open("ab") as printed:
        return subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *words], cwd=folder, env=environment, stdout=printed, stderr=printed
        )


def run_study(folder: Path, sweep: str, name: str, *words: str) -> optuna.Study:
    """Run a study without final evaluation to its end, or resume it, and return it.

    Args:
        folder: Folder of the study, created if missing.
        sweep: Name of the sweep.
        name: Name of the study, and of its log.
        *words: Further overrides.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{name}.log").open("a") as log:
        subprocess.run(
            [
                sys.executable,
                "-m",
                "armscan.run",
                "-m",
                f"sweep={sweep}",
                f"study.name={name}",
                *WITHOUT_FINAL_EVAL,
                *words,
            ],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
            stdout=log,
            stderr=log,
            check=True,
        )
    return optuna.load_study(study_name=name, storage=open_storage(str(folder / JOURNAL)).optuna)


def finish(folder: Path, *words: str) -> StudyState:
    """Run a study in a folder to its end, and return its state."""
    if started(folder, *words).wait() != 0:
        sys.exit((folder / "printed").read_text())
    return state_in(folder)


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

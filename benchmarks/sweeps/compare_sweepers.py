"""Run the same trials with a study of armscan and with Hydra's own Optuna sweeper, one after the other.

Hydra's sweeper needs other versions than armscan (`hydra_optuna/requirements.txt`) and runs in its own virtual
environment, created once in the cache folder. It starts trials in batches, one per worker, and waits for a whole batch
before the next. Both keep the study in a file and sample at random, and trial number N takes equally long with both. A
study of armscan does more: each trial is tracked in MLflow, and reports ten times.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import time
import venv
from dataclasses import dataclass
from pathlib import Path

import optuna
from optuna.trial import TrialState

from armscan.utils.files import cache_folder
from benchmarks.repository import environment
from benchmarks.sweeps.occupancy import Occupation, share_in_trials, slept
from benchmarks.sweeps.studies import N_WORKERS
from benchmarks.sweeps.wait import WAITED_FILE, Waited
from benchmarks.tables import print_head, print_row

HYDRA_OPTUNA = Path(__file__).parent / "hydra_optuna"


@dataclass(frozen=True)
class Sweep:
    """Outcome of a sweep.

    Args:
        occupation: Occupation of its workers.
        n_finished: Number of trials whose result is in the storage.
        command_s: Seconds that the command took, the start of its workers included.
    """

    occupation: Occupation
    n_finished: int
    command_s: float


def compare(folder: Path, *, trials: int = 60, shortest_s: float = 6.0, longest_s: float = 30.0) -> None:
    """Run both, and print the table."""
    python = hydra_python()
    start_s = time.monotonic()
    state = slept(folder, trials, shortest_s, longest_s)
    ours = Sweep(Occupation.of_study(state), len(state.finished), time.monotonic() - start_s)
    sweeps = ours, _by_hydra(python, folder, trials, shortest_s, longest_s)
    occupations = [sweep.occupation for sweep in sweeps]
    rows = {
        "trials finished": [f"{sweep.n_finished}" for sweep in sweeps],
        "trials lost": [f"{trials - sweep.n_finished}" for sweep in sweeps],
        "waiting time of all trials together, s": [f"{each.waited_s:.1f}" for each in occupations],
        "from the first trial's start to the last trial's end, s": [f"{each.wall_s:.1f}" for each in occupations],
        "the whole command, s": [f"{sweep.command_s:.1f}" for sweep in sweeps],
        "share of the workers' time spent waiting in trials": [f"{each.share_of_wall:.1%}" for each in occupations],
        "the same, each worker counted until its own last trial": [
            f"{each.share_until_last:.1%}" for each in occupations
        ],
        "the same, from a trial's claim to its tell": [f"{share_in_trials(state):.1%}", ""],
    }
    print_head("", "armscan", "Hydra's Optuna sweeper")
    for name, cells in rows.items():
        print_row(name, *cells)


def hydra_python() -> Path:
    """Return the Python of the virtual environment of Hydra's sweeper, which is created if missing."""
    requirements = HYDRA_OPTUNA / "requirements.txt"
    version = hashlib.sha256(requirements.read_bytes()).hexdigest()[:12]
    folder = cache_folder() / f"hydra_optuna-{version}"
    python, is_whole = folder / "bin" / "python", folder / "installed"
    if not is_whole.exists():
        print(f"installing {requirements} in {folder}", flush=True)
        venv.create(folder, clear=True, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", "--requirement", requirements], check=True)
        is_whole.touch()
    return python


def _by_hydra(python: Path, folder: Path, trials: int, shortest_s: float, longest_s: float) -> Sweep:
    database, sweep = folder / "hydra_optuna.db", folder / "hydra_optuna"
    words = (
        *("-m", f"workers={N_WORKERS}", f"shortest_s={shortest_s}", f"longest_s={longest_s}"),
        *(f"hydra.sweep.dir={sweep}", f"hydra.sweeper.storage=sqlite:///{database}"),
        f"hydra.sweeper.n_trials={trials}",
    )
    start_s = time.monotonic()
    with (folder / "hydra_optuna.log").open("w") as log:
        command = [python, HYDRA_OPTUNA / "app.py", *words]
        subprocess.run(command, cwd=folder, env=environment(), stdout=log, stderr=log, check=True)
    command_s = time.monotonic() - start_s
    of_worker: dict[str, list[Waited]] = {}
    for file in sweep.glob(f"*/{WAITED_FILE}"):
        left = json.loads(file.read_text())
        of_worker.setdefault(left["worker"], []).append(Waited(*left["waited"]))
    assert len(of_worker) <= N_WORKERS, "a worker was replaced, so that nobody knows until when it counts"
    study = optuna.load_study(study_name="sleeping", storage=f"sqlite:///{database}")
    n_finished = len(study.get_trials(states=[TrialState.COMPLETE]))
    return Sweep(Occupation(of_worker), n_finished, command_s)

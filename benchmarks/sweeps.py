"""What a study costs beside its trials, and what is left of it when its workers are killed.

    python -m benchmarks.sweeps idle [folder=FOLDER]      how much of the workers' time is spent in trials
    python -m benchmarks.sweeps kill [folder=FOLDER] [trials=200] [every_s=20] [storage=journal]
                                                          200 trials, workers killed, the storage away twice

storage=journal      its lock is held by somebody else
storage=sqlite       its file is locked by somebody else
storage=postgresql   a server of its own is stopped and started again

Trials only wait (`benchmarks/sleeping.py`), 1 to 5 seconds, so that four workers can be had on two cores.
"""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import optuna
from filelock import FileLock

from armscan.sweeps.ledger import FIGURES, RETRY_OF, Tally
from armscan.sweeps.storage import open_storage
from armscan.sweeps.supervising import local_workers
from tests.postgres import postgres_server

N_WORKERS = 4
JOURNAL, AWAY_S = "optuna.journal", 10.0
REPOSITORY = Path(__file__).parent.parent
WORDS = [
    *("-m", "sweeps=sac_y", "study.task._target_=benchmarks.sleeping.Sleeping", "study/sampler=random"),
    *("study/pruner=none", "study.judging.best=0", f"study.workers={N_WORKERS}", "study.name=sleeping"),
    "+study.space={training.env_steps:{low:1000,high:5000},agent.lr:{low:1.0e-4,high:1.0e-2}}",
]
# The cores are not what is measured: a trial that waits needs none.
PROGRAM = """
import os, sys
os.sched_getaffinity = lambda _: range(64)
from armscan.run import main
sys.exit(main())
"""


def started(folder: Path, *words: str) -> subprocess.Popen[bytes]:
    """Starts the study in a folder."""
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    with (folder / "printed").open("ab") as printed:
        return subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *WORDS, *words], cwd=folder, env=environment, stdout=printed, stderr=printed
        )


def tally_in(folder: Path, uri: str = JOURNAL) -> Tally:
    """Returns how the study of a folder stands."""
    storage = open_storage(uri if "://" in uri else str(folder / uri))
    if "sleeping" not in optuna.get_all_study_names(storage.optuna):
        return Tally.of([])
    return Tally.of(optuna.load_study(study_name="sleeping", storage=storage.optuna).trials)


def workers_in(folder: Path) -> list[int]:
    """Returns the processes of the workers that are at work."""
    return [each.pid for start in folder.glob("studies/sleeping/workers/*") for each in local_workers(start)]


def idle(folder: Path) -> None:
    """Measures how much of the workers' time is spent in trials, and what each trial takes beside its task."""
    assert started(folder, "study.n_trials=60").wait() == 0, (folder / "printed").read_text()
    finished = tally_in(folder).finished
    begin, end = (moment(getattr(trial, f"datetime_{which}") for trial in finished) for moment, which in ENDS)
    inside_s = [(trial.datetime_complete - trial.datetime_start).total_seconds() for trial in finished]
    slept_s = [trial.user_attrs[FIGURES]["slept_s"] for trial in finished]
    # At the end no trial is left for a worker that has finished its last: until then.
    of_worker: dict[str, list[optuna.trial.FrozenTrial]] = {}
    for trial in finished:
        of_worker.setdefault(trial.user_attrs["lease"]["worker"], []).append(trial)
    present_s = sum((max(t.datetime_complete for t in each) - begin).total_seconds() for each in of_worker.values())
    beside_s = sorted(inside - slept for inside, slept in zip(inside_s, slept_s, strict=True))
    print(f"{len(finished)} trials by {len(of_worker)} workers in {(end - begin).total_seconds():.1f} s")
    print(f"of the workers' time {sum(inside_s) / present_s:.1%} in trials, {sum(slept_s) / present_s:.1%} in tasks")
    print(f"beside its task a trial takes {beside_s[len(beside_s) // 2]:.2f} s (median), {beside_s[-1]:.2f} s at most")


ENDS = ((min, "start"), (max, "complete"))


def kill(folder: Path, n_trials: int, every_s: float, kind: str) -> None:
    """Kills workers, and takes the storage away twice, until the study is done; counts what has become of it."""
    with storage_of_kind(kind, folder) as (uri, take_away):
        process = started(folder, f"study.n_trials={n_trials}", f"study.storage={uri}")
        chance, n_killed, n_away, start_s = random.Random(0), 0, 0, time.monotonic()
        next_s = start_s
        while process.poll() is None:
            time.sleep(0.2)
            if time.monotonic() < next_s + every_s or not (workers := workers_in(folder)):
                continue
            next_s = time.monotonic()
            os.kill(chance.choice(workers), signal.SIGKILL)
            n_killed += 1
            if n_killed in (3, 6):
                take_away()
                n_away += 1
        took_s, tally = time.monotonic() - start_s, tally_in(folder, uri)
    retries = Counter(trial.user_attrs[RETRY_OF] for trial in tally.all if RETRY_OF in trial.user_attrs)
    print(f"{n_killed} workers killed, the storage away {n_away} times, {took_s:.0f} s")
    print(
        f"{len(tally.finished)} of {n_trials} trials finished, {len(tally.failed)} failed, {len(tally.retried)} taken "
        f"up again, {len(tally.running)} left running, {len(tally.waiting)} waiting"
    )
    print(f"taken up more than once: {sum(count > 1 for count in retries.values())}; exit code {process.returncode}")


@contextmanager
def storage_of_kind(kind: str, folder: Path) -> Iterator[tuple[str, Callable[[], None]]]:
    """A storage, and what takes it away from the workers for a while."""
    match kind:
        case "journal":
            yield JOURNAL, partial(hold_lock, folder / f".{JOURNAL}.lock")
        case "sqlite":
            yield f"sqlite:///{folder}/optuna.db", partial(lock_file, folder / "optuna.db")
        case "postgresql":
            with postgres_server() as server:
                yield server.make_database(), partial(server.restart, away_s=AWAY_S)
        case _:
            sys.exit(__doc__)


def hold_lock(file: Path) -> None:
    """Holds the lock of a journal."""
    with FileLock(file):
        time.sleep(AWAY_S)


def lock_file(file: Path) -> None:
    """Locks a file of SQLite."""
    with closing(sqlite3.connect(file, isolation_level=None, timeout=60.0)) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        time.sleep(AWAY_S)


def main(words: list[str]) -> None:
    """Runs what is asked for."""
    given = dict(word.split("=", 1) for word in words if "=" in word)
    what = [word for word in words if "=" not in word]
    folder = Path(given.get("folder", tempfile.mkdtemp())).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    if what == ["idle"]:
        idle(folder)
    elif what == ["kill"]:
        kill(
            folder,
            int(given.get("trials", "200")),
            float(given.get("every_s", "20")),
            given.get("storage", "journal"),
        )
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])

"""Run a study while its workers are killed and its storage is unavailable twice; count its trials."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path

from filelock import FileLock

from armscan.sweeps.storage.attribute_names import RETRY_OF
from armscan.sweeps.workers.supervisor import local_workers
from benchmarks.sweeps.studies import JOURNAL, NAME, SLEEPING, started, state_in
from tests.support.postgres import postgres_server

AWAY_S = 10.0


def kill(folder: Path, *, trials: int = 200, every_s: float = 20.0, storage: str = "journal") -> None:
    """Kill workers, and make the storage unavailable twice, until the study is done; count its trials."""
    with storage_of_kind(storage, folder) as (uri, take_away):
        process = started(folder, *SLEEPING, f"study.n_trials={trials}", f"study.storage={uri}")
        chance, n_killed, n_away, start_s = random.Random(0), 0, 0, time.monotonic()
        next_s = start_s
        while process.poll() is None:
            time.sleep(0.2)
            if time.monotonic() < next_s + every_s or not (workers := workers_in(folder)):
                continue
            next_s = time.monotonic()
            # It may have ended by itself since.
            with suppress(ProcessLookupError):
                os.kill(chance.choice(workers), signal.SIGKILL)
            n_killed += 1
            if n_killed in (3, 6):
                take_away()
                n_away += 1
        took_s, state = time.monotonic() - start_s, state_in(folder, uri)
    retries = Counter(trial.user_attrs[RETRY_OF] for trial in state.all if RETRY_OF in trial.user_attrs)
    print(f"{n_killed} workers killed, the storage away {n_away} times, {took_s:.0f} s")
    print(
        f"{len(state.finished)} of {trials} trials finished, {len(state.failed)} failed, {len(state.retried)} taken "
        f"up again, {len(state.running)} left running, {len(state.waiting)} waiting"
    )
    print(f"taken up more than once: {sum(count > 1 for count in retries.values())}; exit code {process.returncode}")


def workers_in(folder: Path) -> list[int]:
    """Return the process IDs of the running workers."""
    return [each.pid for start in folder.glob(f"studies/{NAME}/workers/*") for each in local_workers(start)]


@contextmanager
def storage_of_kind(kind: str, folder: Path) -> Iterator[tuple[str, Callable[[], None]]]:
    """Yield a storage's URI, and a function that makes it unavailable to the workers for `AWAY_S`."""
    match kind:
        case "journal":
            yield JOURNAL, partial(hold_lock, folder / f".{JOURNAL}.lock")
        case "sqlite":
            yield f"sqlite:///{folder}/optuna.db", partial(lock_file, folder / "optuna.db")
        case "postgresql":
            with postgres_server() as server:
                yield server.make_database(), partial(server.restart, away_s=AWAY_S)
        case _:
            sys.exit(f"storage is {kind!r}, but it must be journal, sqlite or postgresql")


def hold_lock(file: Path) -> None:
    """Hold the lock of a journal for `AWAY_S`."""
    with FileLock(file):
        time.sleep(AWAY_S)


def lock_file(file: Path) -> None:
    """Lock a SQLite file for `AWAY_S`."""
    with closing(sqlite3.connect(file, isolation_level=None, timeout=60.0)) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        time.sleep(AWAY_S)

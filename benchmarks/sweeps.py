"""What a study costs beside its trials, and what is left of it when its workers are killed.

    python -m benchmarks.sweeps compare [folder=FOLDER] [trials=60] [shortest_s=6] [longest_s=30]
                                        the workers' time spent in trials, beside Hydra's own Optuna sweeper
    python -m benchmarks.sweeps idle [folder=FOLDER] [trials=60] [shortest_s=1] [longest_s=5]
                                        the same of armscan alone, with trials that are over soon
    python -m benchmarks.sweeps beside [folder=FOLDER] [trials=4]
                                        what a study adds to a training of a minute
    python -m benchmarks.sweeps kill [folder=FOLDER] [trials=200] [every_s=20]
                                        200 trials, workers killed, the storage locked twice

But for `beside`, trials only wait (`benchmarks/sleeping.py`), so that four workers can be had on two cores.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock

from armscan.sweeps.ledger import RETRY_OF
from benchmarks.beside import beside
from benchmarks.compare_sweepers import compare
from benchmarks.occupation import idle
from benchmarks.studies import NAME, SLEEPING, started, tally_in


def workers_in(folder: Path) -> list[int]:
    """Returns the processes of the workers."""
    files = folder.glob(f"studies/{NAME}/workers/*/worker-*.json")
    return [int(json.loads(file.read_text())["pid"]) for file in files]


def kill(folder: Path, *, trials: int = 200, every_s: float = 20.0) -> None:
    """Kills workers, and holds the lock of the storage, until the study is done; counts what has become of it."""
    process = started(folder, *SLEEPING, f"study.n_trials={trials}")
    chance, n_killed, n_locked = random.Random(0), 0, 0
    start_s = next_s = time.monotonic()
    while process.poll() is None:
        time.sleep(0.2)
        if time.monotonic() < next_s + every_s or not workers_in(folder):
            continue
        next_s = time.monotonic()
        os.kill(chance.choice(workers_in(folder)), signal.SIGKILL)
        n_killed += 1
        if n_killed in (3, 6):
            with FileLock(folder / ".optuna.journal.lock"):
                time.sleep(10.0)
            n_locked += 1
    tally = tally_in(folder)
    retries = Counter(trial.user_attrs[RETRY_OF] for trial in tally.all if RETRY_OF in trial.user_attrs)
    print(f"{n_killed} workers killed, the storage locked {n_locked} times, {time.monotonic() - start_s:.0f} s")
    print(
        f"{len(tally.finished)} of {trials} trials finished, {len(tally.failed)} failed, {len(tally.retried)} taken "
        f"up again, {len(tally.running)} left running, {len(tally.waiting)} waiting"
    )
    print(f"taken up more than once: {sum(count > 1 for count in retries.values())}; exit code {process.returncode}")


MEASURES: dict[str, Callable[..., None]] = {"compare": compare, "idle": idle, "beside": beside, "kill": kill}


def main(words: list[str]) -> None:
    """Measures what is asked for."""
    given = dict(word.split("=", 1) for word in words if "=" in word)
    what = [word for word in words if "=" not in word]
    if len(what) != 1 or what[0] not in MEASURES:
        sys.exit(__doc__)
    folder = Path(given.pop("folder", "") or tempfile.mkdtemp()).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    MEASURES[what[0]](folder, **{name: json.loads(number) for name, number in given.items()})


if __name__ == "__main__":
    main(sys.argv[1:])

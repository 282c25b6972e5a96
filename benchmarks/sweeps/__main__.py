"""Measure the overhead of a study, and how it survives killed workers.

    python -m benchmarks.sweeps compare [folder=FOLDER] [trials=60] [shortest_s=6] [longest_s=30]
                                        share of worker time spent in trials, compared with Hydra's own Optuna sweeper
    python -m benchmarks.sweeps same_budget [folder=FOLDER] [tasks=[sac_y]] [first=0] [replicates=4] [seeds=8]
                                        what both find with the same processor time, in real trainings
    python -m benchmarks.sweeps idle [folder=FOLDER] [trials=60] [shortest_s=1] [longest_s=5]
                                        share of worker time spent in trials, armscan alone with short trials
    python -m benchmarks.sweeps beside [folder=FOLDER] [trials=10]
                                        what a study adds to a training
    python -m benchmarks.sweeps kill [folder=FOLDER] [trials=200] [every_s=20] [storage=journal]
                                        trials finished although workers are killed, and the storage
                                        (journal, sqlite or postgresql) is unavailable twice

Except in `same_budget` and `beside`, trials only wait (`benchmarks/sweeps/sleeping.py`), so that two cores are enough
for four workers.
"""

from __future__ import annotations

import os

# Before the libraries that start threads are imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from collections.abc import Callable

from benchmarks.sweeps.compare_sweepers import compare
from benchmarks.sweeps.kill_workers import kill
from benchmarks.sweeps.occupancy import idle
from benchmarks.sweeps.overhead import beside
from benchmarks.sweeps.same_budget import same_budget
from benchmarks.sweeps.studies import call

MEASURES: dict[str, Callable[..., None]] = {
    "compare": compare,
    "same_budget": same_budget,
    "idle": idle,
    "beside": beside,
    "kill": kill,
}


def main(words: list[str]) -> None:
    """Run the benchmark that the words name."""
    what = [word for word in words if "=" not in word]
    if len(what) != 1 or what[0] not in MEASURES:
        sys.exit(__doc__)
    call(MEASURES[what[0]], [word for word in words if "=" in word])


if __name__ == "__main__":
    main(sys.argv[1:])

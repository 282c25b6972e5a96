"""Measure the overhead of a study, and how it survives killed workers.

    python -m benchmarks.sweeps MEASURE [--folder FOLDER] [OPTION ...]

    compare       share of worker time spent in trials, compared with Hydra's own Optuna sweeper
    same-budget   what both find with the same processor time, in real trainings
    idle          share of worker time spent in trials, armscan alone with short trials
    beside        what a study adds to a training
    kill          trials finished although workers are killed, and the storage (journal, sqlite or postgresql) is
                  unavailable twice

Each has `--help`. Except in `same-budget` and `beside`, trials only wait (`benchmarks/sweeps/sleeping.py`), so that two
cores are enough for four workers.
"""

from __future__ import annotations

import os

# Before the libraries that start threads are imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from benchmarks.arguments import add_options_of, call, parser_of, run_script
from benchmarks.sweeps.compare_sweepers import compare
from benchmarks.sweeps.kill_workers import kill
from benchmarks.sweeps.occupancy import idle
from benchmarks.sweeps.overhead import beside
from benchmarks.sweeps.same_budget import same_budget


def main() -> None:
    """Run the benchmark that the first argument names."""
    parser = parser_of(__doc__)
    measures = parser.add_subparsers(metavar="MEASURE", required=True)
    for measure in (compare, same_budget, idle, beside, kill):
        of_measure = measures.add_parser(measure.__name__.replace("_", "-"))
        add_options_of(of_measure, measure)
        of_measure.set_defaults(measure=measure)
    given = parser.parse_args()
    call(vars(given).pop("measure"), given)


if __name__ == "__main__":
    run_script(main)

"""A bench for studies: which sampler, pruner and rule of seeds finds the best settings with the fewest trainings.

python -m benchmarks.sweeps.bench collect sac_y [--configs N] [--seeds N] [--workers N]
"""

from __future__ import annotations

import os

# Before the libraries that start threads are imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse

from benchmarks.sweeps.bench.collect import collect


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sweeps.bench", description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    collecting = commands.add_parser("collect", help="train what is missing in a table")
    collecting.add_argument("sweep", help="name of the sweep, such as sac_y")
    collecting.add_argument("--configs", type=int, default=300, help="configurations (default: 300)")
    collecting.add_argument("--seeds", type=int, default=8, help="trainings of each (default: 8)")
    collecting.add_argument("--workers", type=int, default=1, help="processes that train (default: 1)")
    collecting.add_argument("--allow-changes", action="store_true", help="although settings have changed since")
    given = parser.parse_args()
    collect(given.sweep, given.configs, given.seeds, given.workers, allow_changes=given.allow_changes)


if __name__ == "__main__":
    main()

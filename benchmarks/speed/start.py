"""Processor time of commands until they answer, and of a run until its first training step, in fresh processes.

    python -m benchmarks.speed.start [--before CHECKOUT]

Each figure is the least of several processes, after one that has compiled everything, made the phantoms and the store.
With `--before`, each process of this checkout is followed by one of the other, whose figure stands beside it.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

N_PROCESSES = 3
HERE = Path(__file__).resolve().parents[2]
RUN = "import sys; from armscan.__main__ import main; sys.exit(main())"
# Ends a run where its learner would take the first step.
UNTIL_TRAINING = """
import os, sys
import armscan.agents.tianshou_learner as learner
learner.TianshouLearner.warm_up = lambda self: os._exit(0)
sys.argv = ["armscan", *sys.argv[1:]]
from armscan.run import main
main()
"""
VOLUMES = str(HERE / "tests" / "data" / "volumes")
COMMANDS = {
    "a wrong word, `run training.env_steps=-1`": (RUN, "run", "training.env_steps=-1"),
    "`run data=nifti` without a path": (RUN, "run", "data=nifti"),
    "`run resume=zzzz`": (RUN, "run", "resume=zzzz"),
    "`runs list`": (RUN, "runs", "list"),
    "`report --runs` of a run that is not there": (RUN, "report", "--runs", "abcd"),
    "`ui --help`": (RUN, "ui", "--help"),
    "`data inspect`, four volumes": (RUN, "data", "inspect", VOLUMES),
    "`run`, until the first training step": (UNTIL_TRAINING,),
}


def processor_s(checkout: Path, folder: str, program: str, *words: str) -> float:
    """Return the processor seconds of a fresh process, of its own and of its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-c", program, *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--before", type=Path, metavar="CHECKOUT", help="Another checkout to measure beside this one.")
    other = parser.parse_args().before
    checkouts = {**({"before": other.resolve()} if other else {}), "now": HERE}
    print(f"| processor seconds | {' | '.join(checkouts)} |\n| --- |{' ---: |' * len(checkouts)}")
    with tempfile.TemporaryDirectory() as folder:
        for checkout in checkouts.values():
            processor_s(checkout, folder, *COMMANDS["`run`, until the first training step"])
        for name, command in COMMANDS.items():
            rounds = [[processor_s(each, folder, *command) for each in checkouts.values()] for _ in range(N_PROCESSES)]
            least = (min(column) for column in zip(*rounds, strict=True))
            print(f"| {name} | {' | '.join(f'{seconds:.1f}' for seconds in least)} |", flush=True)


if __name__ == "__main__":
    main()

"""Processor time of whole trainings, and of whole runs, beside those of an earlier checkout.

    python -m benchmarks.speed.training [--before CHECKOUT] [--rounds N] [CASE ...]

Each training is a run in a fresh process, tracked in SQLite, one thread for BLAS and torch; those of both checkouts
take turns, after one short run of each that compiles everything and makes the phantoms. Figures are medians over the
rounds. Cases: `default` (20,000 steps, never stopped early), `make_run` (the default run), `best_full`
(`experiment=best_full`); default: the first two.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.speed.checkouts import HERE

CASES = {"default": ["training.solved=null"], "make_run": [], "best_full": ["experiment=best_full"]}
DEFAULT_CASES = ("default", "make_run")
SHORT = ["training.env_steps=2500", "training.eval_every_env_steps=500", "evaluation.episodes=8"]
PROGRAM = """
import sys, time
import armscan.experiment.runner as runner
train = runner.train
def timed(*arguments, **options):
    start_s = time.process_time()
    result = train(*arguments, **options)
    print("trained", time.process_time() - start_s, result.reports[-1].n_env_steps)
    return result
runner.train = timed
sys.argv = ["armscan", *sys.argv[1:]]
from armscan.run import main
main()
"""


def run(checkout: Path, *words: str) -> tuple[float, float, int]:
    """Return processor seconds of a run's training and of all of it, and the training's environment steps."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        said = subprocess.run(
            [sys.executable, "-c", PROGRAM, *words],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            check=True,
        ).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    (line,) = (line for line in said.splitlines() if line.startswith("trained "))
    _, seconds, n_steps = line.split()
    whole_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return float(seconds), whole_s, int(n_steps)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--before", type=Path, help="another checkout to compare with")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each (default: 3)")
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"{', '.join(CASES)} (default: the first two)")
    given = parser.parse_args()
    if unknown := set(given.cases) - set(CASES):
        parser.error(f"unknown cases: {', '.join(sorted(unknown))}")
    checkouts = [each.resolve() for each in (HERE, given.before) if each]
    for checkout in checkouts:
        run(checkout, *SHORT)
    print("| run | steps | training, s | before, s | ratio | all of it, s | before, s | ratio |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    for case in given.cases or DEFAULT_CASES:
        rounds = [[run(checkout, *CASES[case]) for checkout in checkouts] for _ in range(given.rounds)]
        training, whole = (
            [statistics.median(each[which][part] for each in rounds) for which in range(len(checkouts))]
            for part in (0, 1)
        )
        cells = [
            cell
            for now, *before in (training, whole)
            for cell in (f"{now:.1f}", *(f"{each:.1f} | {each / now:.1f}" for each in before or []))
        ]
        n_steps = " and ".join(f"{each[2]:,}" for each in rounds[0])
        print(f"| {case} | {n_steps} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()

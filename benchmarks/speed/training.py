"""Measure the time of trainings and of whole runs, compared with an earlier checkout.

    python -m benchmarks.speed.training [--before CHECKOUT] [--rounds N] [CASE ...]

Each training is a run in a fresh process, tracked in SQLite, one thread for BLAS and torch. Both checkouts take turns,
after one short run of each that compiles everything and makes the phantoms. Figures are medians over the
rounds. Cases: `default` (20,000 steps, never stopped early), `make_run` (the default run), `best_full`
(`experiment=best_full`); default: the first two.
"""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path
from typing import NamedTuple

from benchmarks.repository import REPOSITORY
from benchmarks.speed.checkouts import comparing_parser_of, run_timed
from benchmarks.tables import print_head, print_row

CASES = {"default": ["training.solved=null"], "make_run": [], "best_full": ["experiment=best_full"]}
DEFAULT_CASES = ("default", "make_run")
COLUMNS = ("training, processor s", "all of it, processor s", "all of it, wall s")
SHORT = ["training.env_steps=2500", "training.eval_every_env_steps=500", "evaluation.episodes=8"]
PROGRAM = """
import sys, time
import armscan.experiment.runner as runner
train = runner.train
def timed(*arguments, **options):
    processor_s, start_s = time.process_time(), time.perf_counter()
    result = train(*arguments, **options)
    used_s = time.process_time() - processor_s, time.perf_counter() - start_s
    print("trained", *used_s, result.reports[-1].n_env_steps)
    return result
runner.train = timed
sys.argv = ["armscan", *sys.argv[1:]]
from armscan.run import main
main()
"""


class Run(NamedTuple):
    """Processor and wall seconds of a run, and of its training alone; environment steps of the training."""

    training_s: float
    processor_s: float
    wall_s: float
    n_env_steps: int
    training_wall_s: float


def run(checkout: Path, *words: str) -> Run:
    """Run the command with the code of a checkout, and measure it."""
    with tempfile.TemporaryDirectory() as folder:
        said, processor_s, wall_s = run_timed(checkout, folder, "-c", PROGRAM, *words)
    (line,) = (line for line in said.splitlines() if line.startswith("trained "))
    _, seconds, training_wall_s, n_steps = line.split()
    return Run(float(seconds), processor_s, wall_s, int(n_steps), float(training_wall_s))


def main() -> None:
    """Print the table."""
    parser = comparing_parser_of(__doc__, n_rounds=3)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"{', '.join(CASES)} (default: the first two)")
    given = parser.parse_args()
    if unknown := set(given.cases) - set(CASES):
        parser.error(f"unknown cases: {', '.join(sorted(unknown))}")
    checkouts = [each for each in (REPOSITORY, given.before) if each]
    for checkout in checkouts:
        run(checkout, *SHORT)
    beside = ["before", "ratio: median, least, most"] if given.before else []
    print_head("run", "steps", *(cell for title in COLUMNS for cell in (title, *beside)))
    for case in given.cases or DEFAULT_CASES:
        rounds = [[run(checkout, *CASES[case]) for checkout in checkouts] for _ in range(given.rounds)]
        cells = [case, " and ".join(f"{each.n_env_steps:,}" for each in rounds[0])]
        for column in range(len(COLUMNS)):
            seconds = [[each[column] for each in of_round] for of_round in rounds]
            cells += [f"{statistics.median(each):.1f}" for each in zip(*seconds, strict=True)]
            if given.before:
                ratios = [before / now for now, before in seconds]
                cells.append(f"{statistics.median(ratios):.2f}, {min(ratios):.2f}, {max(ratios):.2f}")
        print_row(*cells)


if __name__ == "__main__":
    main()

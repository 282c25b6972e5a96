"""Measure the processor time of the trials of `sac_y` in a warm worker, compared with an earlier checkout.

    python -m benchmarks.speed.trials [--before CHECKOUT] [--trials N]

One worker in its own process runs N trials (default: 4) without pruning. A trial counts after its claim until before
its tell; the mean leaves out the first, which imports and compiles. The sampler draws the first trials at random from
the study's seed, so that both checkouts have the same ones.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.repository import REPOSITORY, environment
from benchmarks.speed.checkouts import comparing_parser_of
from benchmarks.tables import print_head, print_row

# Python imports this `sitecustomize` at the start of each process; in the worker's, it times the trials.
SITE = """
import importlib.util, os, sys, time
NAME = "armscan.sweeps.workers.worker"
class Timed:
    def find_spec(self, name, path=None, target=None):
        if name != NAME:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        load = spec.loader.exec_module
        def exec_module(module):
            load(module)
            run = module.Worker._run
            def timed(self, trial):
                start_s = time.process_time()
                try:
                    return run(self, trial)
                finally:
                    with open(os.environ["SECONDS_FILE"], "a") as file:
                        print(time.process_time() - start_s, file=file)
            module.Worker._run = timed
        spec.loader.exec_module = exec_module
        return spec
sys.meta_path.insert(0, Timed())
"""
WORDS = (
    "-m",
    "sweep=sac_y",
    "hydra/launcher=basic",
    "study.workers=1",
    "study/pruner=none",
    "study.final_eval.top_k=0",
    # The same for every checkout: today's `sac_y` has other numbers of volumes, and enqueues a preset.
    "data.n_validation=4",
    "data.n_test=8",
)
WITHOUT_PRESETS = "study.enqueue=[]"


def trial_seconds(checkout: Path, n_trials: int) -> list[float]:
    """Return the processor seconds of each trial."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = Path(folder) / "seconds.txt"
        (Path(folder) / "sitecustomize.py").write_text(SITE)
        has_presets = "enqueue:" in (checkout / "sweeps" / "sac_y.yaml").read_text()
        words = (*WORDS, *([WITHOUT_PRESETS] if has_presets else []), f"study.n_trials={n_trials}")
        subprocess.run(
            [sys.executable, "-m", "armscan.run", *words],
            cwd=folder,
            env=environment(f"{folder}:{checkout}", SECONDS_FILE=str(seconds)),
            stdout=subprocess.DEVNULL,
            check=True,
        )
        return [float(word) for word in seconds.read_text().split()]


def main() -> None:
    """Print the table."""
    parser = comparing_parser_of(__doc__)
    parser.add_argument("--trials", type=int, default=4, help="trials of each (default: 4)")
    given = parser.parse_args()
    if given.trials < 2:
        parser.error(f"--trials is {given.trials}: the first is not warm, so it must be 2 or more")
    seconds = [trial_seconds(each, given.trials) for each in (REPOSITORY, given.before) if each]
    print_head("trial", "processor s", *(("before", "ratio") if given.before else ()))
    for number, (now, *before) in enumerate(zip(*seconds, strict=True)):
        first = " (the first)" if number == 0 else ""
        beside = (f"{figure:.1f}" for each in before for figure in (each, each / now))
        print_row(f"{number}{first}", f"{now:.1f}", *beside)
    warm = [sum(each[1:]) / (given.trials - 1) for each in seconds]
    print(f"\nwarm, mean: {' and before '.join(f'{each:.1f} s' for each in warm)}")
    print(f"two quiet cores would finish {2 * 3600 / warm[0]:.0f} an hour")


if __name__ == "__main__":
    main()

"""A bench for studies: which sampler, pruner and rule of seeds finds the best settings with the fewest trainings.

python -m benchmarks.sweeps.bench collect sac_y [--configs N] [--seeds N] [--workers N]
python -m benchmarks.sweeps.bench report sac_y [--studies N] [--workers N] [--picture FILE]
python -m benchmarks.sweeps.bench collect-episodes sac_y [--seeds N] [--workers N]
python -m benchmarks.sweeps.bench report-episodes sac_y [--studies N]
python -m benchmarks.sweeps.bench warm-start sac_y sac_zy [--studies N] [--pruner NAME] [--cold-pruner NAME]
"""

from __future__ import annotations

import os

# Before the libraries that start threads are imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from itertools import product

from benchmarks.arguments import count, new_file, run_script
from benchmarks.sweeps.bench.collect import collect
from benchmarks.sweeps.bench.episodes import collect_evaluations
from benchmarks.sweeps.bench.ranking import SAMPLERS
from benchmarks.sweeps.bench.replay import DEFAULT, silence
from benchmarks.sweeps.bench.report import report, report_episodes, with_interval
from benchmarks.sweeps.bench.warm_start import BEGUN, COLD, UNITS, SimulatedSweep, replays, share_of


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sweeps.bench", description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    collecting = commands.add_parser("collect", help="train what is missing in a table")
    collecting.add_argument("sweep", help="name of the sweep, such as sac_y")
    collecting.add_argument("--configs", type=count, default=300, help="configurations (default: 300)")
    collecting.add_argument("--seeds", type=count, default=8, help="trainings of each (default: 8)")
    collecting.add_argument("--workers", type=count, default=1, help="processes that train (default: 1)")
    collecting.add_argument("--allow-changes", action="store_true", help="although settings have changed since")
    replaying = commands.add_parser("report", help="simulate studies, and print their tables")
    replaying.add_argument("sweep", help="name of the sweep, such as sac_y")
    replaying.add_argument("--studies", type=count, default=200, help="studies of each rule (default: 200)")
    replaying.add_argument("--trainings", type=count, default=40, help="budget of each search (default: 40)")
    replaying.add_argument("--resamples", type=count, default=50, help="resamples of importances (default: 50)")
    replaying.add_argument(
        "--samplers",
        nargs="+",
        choices=(*SAMPLERS, "gp"),
        default=SAMPLERS,
        help="samplers to compare (default: all but gp, which takes hours)",
    )
    replaying.add_argument("--workers", type=count, default=1, help="processes that simulate (default: 1)")
    replaying.add_argument("--picture", type=new_file, help="a PNG file that is written")
    evaluating = commands.add_parser("collect-episodes", help="evaluate good configurations in many episodes")
    evaluating.add_argument("sweep", help="name of the sweep, such as sac_y")
    evaluating.add_argument("--seeds", type=count, default=8, help="trainings of each (default: 8)")
    evaluating.add_argument("--workers", type=count, default=1, help="processes that train (default: 1)")
    comparing = commands.add_parser("report-episodes", help="compare races by the episodes of their evaluations")
    comparing.add_argument("sweep", help="name of the sweep, such as sac_y")
    comparing.add_argument("--studies", type=count, default=200, help="simulated studies (default: 200)")
    comparing.add_argument("--trainings", type=count, default=40, help="budget of each search (default: 40)")
    starting = commands.add_parser("warm-start", help="simulate studies that begin with known settings")
    starting.add_argument("source", help="name of the sweep that the settings are from, such as sac_y")
    starting.add_argument("target", help="name of the sweep that begins with them, such as sac_zy")
    starting.add_argument("--studies", type=count, default=20, help="studies (default: 20)")
    starting.add_argument("--pruner", default=DEFAULT.pruner, help=f"pruner of the target (default: {DEFAULT.pruner})")
    starting.add_argument("--cold-pruner", help="pruner of studies that begin with nothing (default: --pruner)")
    _run(parser.parse_args())


def _run(given: argparse.Namespace) -> None:
    if given.command == "collect":
        collect(given.sweep, given.configs, given.seeds, given.workers, allow_changes=given.allow_changes)
        return
    if given.command == "collect-episodes":
        collect_evaluations(given.sweep, given.seeds, given.workers)
        return
    silence()
    if given.command == "report-episodes":
        report_episodes(given.sweep, n_studies=given.studies, n_trainings=given.trainings)
        return
    if given.command == "warm-start":
        target = SimulatedSweep.of(given.target, given.pruner)
        cold = SimulatedSweep.of(given.target, given.cold_pruner or given.pruner)
        studies = replays(SimulatedSweep.of(given.source), target, given.studies, cold)
        print(studies.to_string())
        for kind, n_reached in studies["reached"].sum().items():
            print(f"{kind}: {n_reached:.0f} of {len(studies)} reach the goal")
        for unit, kind, cold in product(UNITS, BEGUN, COLD):
            share = share_of(studies[unit, kind], studies[unit, cold])
            print(f"{unit}, median of {kind} over {cold}: {with_interval(share, '.2f')}")
    else:
        report(
            given.sweep,
            n_studies=given.studies,
            n_trainings=given.trainings,
            n_resamples=given.resamples,
            samplers=given.samplers,
            workers=given.workers,
            picture=given.picture,
        )


if __name__ == "__main__":
    run_script(main)

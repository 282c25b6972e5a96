"""Measure the memory of several workers that train on the same phantoms, and the time to load these.

    python -m benchmarks.speed.shared_memory [--workers 8] [--phantoms 128]

Each worker imports what a training imports, builds a default SAC learner and its
environments, takes some steps and gradient steps, and reads every voxel. Measured is the sum of their proportional set
sizes (PSS: a page that several processes map counts for each by its share), which counts no page twice.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

from armscan.volumes import load_phantoms
from benchmarks.arguments import count, parser_of
from benchmarks.tables import print_head, print_row

N_STEPS = 400
# Of the slowest worker; if one fails, the others do not wait for ever.
WAIT_S = 1800.0


def pss_bytes() -> int:
    """Return the proportional set size of this process."""
    lines = Path(f"/proc/{os.getpid()}/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))


def work(n_phantoms: int, together: Barrier, answers: Any) -> None:
    """Train for a moment; report PSS in bytes, and wall and processor seconds to load the phantoms."""
    # Imported for the memory that it takes in each worker.
    import mlflow  # noqa: F401

    from armscan.agents import MLP, SAC
    from armscan.envs import EnvFactory
    from benchmarks.speed.agent_setup import agent_setup

    together.wait()
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    volumes = load_phantoms(range(n_phantoms))
    seconds, cpu_seconds = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    setup = agent_setup(EnvFactory(projection="y"), volumes, 20_000)
    learner = SAC(network=MLP((64, 64)), learning_starts=N_STEPS).agent(setup)
    learner.warm_up()
    learner.learn(N_STEPS)
    assert all(volume.labels.max() == 4 for volume in volumes.values())
    together.wait()
    answers.put((pss_bytes(), seconds, cpu_seconds))
    together.wait()


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--workers", type=count, default=8, help="default: %(default)s")
    parser.add_argument("--phantoms", type=count, default=128, help="default: %(default)s")
    given = parser.parse_args()
    n_workers, n_phantoms = given.workers, given.phantoms
    n_voxels = sum(volume.labels.size for volume in load_phantoms(range(n_phantoms)).values())
    context = multiprocessing.get_context("spawn")
    together, answers = context.Barrier(n_workers, timeout=WAIT_S), context.Queue()
    workers = [context.Process(target=work, args=(n_phantoms, together, answers)) for _ in range(n_workers)]
    for worker in workers:
        worker.start()
    reports = [answers.get(timeout=WAIT_S) for _ in workers]
    for worker in workers:
        worker.join()
    n_bytes = sum(pss for pss, _, _ in reports)
    allowed = 1.3 * n_voxels + n_workers * 700 * 2**20
    columns = "MiB of voxels", "PSS of all, MiB", "allowed", "s to load the phantoms", "processor s"
    print_head("workers", "phantoms", *columns)
    slowest, dearest = max(seconds for _, seconds, _ in reports), max(cpu for _, _, cpu in reports)
    figures = (f"{figure / 2**20:.0f}" for figure in (n_voxels, n_bytes, allowed))
    print_row(n_workers, n_phantoms, *figures, f"{slowest:.2f}", f"{dearest:.2f}")


if __name__ == "__main__":
    main()

"""What 8 volumes take in memory, for 64 environments in one process, and in several that share them.

    python -m benchmarks.memory [FOLDER]

What is counted is what the volumes add: the memory with them, less that of the same environments on small volumes. In
several processes it is the proportional set size, in which a page that n processes share counts 1/n in each.
"""

from __future__ import annotations

import multiprocessing
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import armscan  # noqa: F401 - registers the environment
from armscan.envs import make_armscan_vector_env
from armscan.volumes import LabelVolume, ManipulatorAction, load_phantoms, read_dataset, shared_volumes

NUM_ENVS, N_PROCESSES, N_VOLUMES, N_STEPS = 64, 4, 8, 40
RULES = {"projection": "zy", "transform": None, "delta": 1.0}


def proportional_bytes() -> int:
    """The proportional set size of this process."""
    return 1024 * int(re.search(r"Pss:\s+(\d+) kB", Path("/proc/self/smaps_rollup").read_text())[1])


def small_volumes() -> list[LabelVolume]:
    """Volumes of a few kilobytes that show every landmark."""
    labels = np.zeros((40, 30, 20), dtype=np.uint8)
    labels[:15, :, :8], labels[16:28, :, 8:12], labels[30:, :, 12:] = 1, 2, 3
    plane = ManipulatorAction((0.0, 0.0), (0.0, 5.0))
    return [LabelVolume(labels, (1.0, 1.0, 1.0), f"small-{i}", plane) for i in range(N_VOLUMES)]


def bytes_when_stepping(volumes: Sequence[LabelVolume], num_envs: int) -> int:
    """Steps environments until every volume has been seen, and returns what the process then holds."""
    envs = make_armscan_vector_env(num_envs, volumes, **RULES)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    for _ in range(N_STEPS):
        envs.step(envs.action_space.sample())
    return proportional_bytes()


def _in_child(volumes, num_envs, barrier, queue) -> None:
    bytes_when_stepping(volumes, num_envs)
    # All of them hold what they hold before any of them counts.
    barrier.wait()
    queue.put(proportional_bytes())
    barrier.wait()


def bytes_in_children(volumes: Sequence[LabelVolume], n_processes: int) -> int:
    """The sum over fresh processes that share 64 environments among them."""
    context = multiprocessing.get_context("spawn")
    barrier, queue = context.Barrier(n_processes), context.Queue()
    arguments = (volumes, NUM_ENVS // n_processes, barrier, queue)
    children = [context.Process(target=_in_child, args=arguments) for _ in range(n_processes)]
    for child in children:
        child.start()
    total = sum(queue.get() for _ in children)
    for child in children:
        child.join()
    return total


def main() -> None:
    """Prints the table."""
    if len(sys.argv) > 1:
        volumes = list(read_dataset(sys.argv[1]).values())
    else:
        volumes = list(load_phantoms(range(N_VOLUMES)).values())
    n_voxels = sum(volume.labels.size for volume in volumes)
    print(f"{len(volumes)} volumes, {n_voxels / 2**20:.0f} MiB of voxels as uint8; {NUM_ENVS} environments\n")
    print("| | MiB that the volumes add | times their voxels |\n| --- | --- | --- |")
    one = bytes_in_children(volumes, 1) - bytes_in_children(small_volumes(), 1)
    with shared_volumes({volume.name: volume for volume in volumes}) as shared:
        several = bytes_in_children(list(shared.values()), N_PROCESSES) - bytes_in_children(
            small_volumes(), N_PROCESSES
        )
    for name, added in (("one process", one), (f"{N_PROCESSES} processes, shared", several)):
        print(f"| {name} | {added / 2**20:.0f} | {added / n_voxels:.2f} |")


if __name__ == "__main__":
    main()

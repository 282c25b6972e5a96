"""Memory that 8 volumes add to 64 environments in one process.

    python -m benchmarks.speed.memory [FOLDER]

What is counted is what the volumes add: the memory with them, less that of the same environments on small volumes.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Sequence

import numpy as np
import psutil

import armscan  # noqa: F401 - registers the environment
from armscan.envs import make_armscan_vector_env
from armscan.volumes import LabelVolume, ManipulatorAction, load_phantoms, read_dataset

NUM_ENVS, N_VOLUMES, N_STEPS = 64, 8, 40
RULES = {"projection": "zy", "transform": None, "success_threshold": 1.0}


def resident_bytes() -> int:
    """Return the resident set size of this process."""
    return psutil.Process().memory_info().rss


def small_volumes() -> list[LabelVolume]:
    """Volumes of a few kilobytes that show every landmark."""
    labels = np.zeros((40, 30, 20), dtype=np.uint8)
    labels[:15, :, :8], labels[16:28, :, 8:12], labels[30:, :, 12:] = 1, 2, 3
    plane = ManipulatorAction((0.0, 0.0), (0.0, 5.0))
    return [LabelVolume(labels, (1.0, 1.0, 1.0), f"small-{i}", plane) for i in range(N_VOLUMES)]


def bytes_when_stepping(volumes: Sequence[LabelVolume]) -> int:
    """Step environments until every volume has been seen; return the bytes that the process then holds."""
    envs = make_armscan_vector_env(NUM_ENVS, volumes, **RULES)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    for _ in range(N_STEPS):
        envs.step(envs.action_space.sample())
    return resident_bytes()


def bytes_in_child(volumes: Sequence[LabelVolume]) -> int:
    """Return the same for a fresh process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(bytes_when_stepping, (volumes,))


def main() -> None:
    """Print the table."""
    if len(sys.argv) > 1:
        volumes = list(read_dataset(sys.argv[1]).values())
    else:
        volumes = list(load_phantoms(range(N_VOLUMES)).values())
    n_voxels = sum(volume.labels.size for volume in volumes)
    print(f"{len(volumes)} volumes, {n_voxels / 2**20:.0f} MiB of voxels as uint8; {NUM_ENVS} environments\n")
    print("| | MiB that the volumes add | times their voxels |\n| --- | --- | --- |")
    added = bytes_in_child(volumes) - bytes_in_child(small_volumes())
    print(f"| one process | {added / 2**20:.0f} | {added / n_voxels:.2f} |")


if __name__ == "__main__":
    main()

"""Memory that 8 volumes add to 64 environments in one process, and memory over a million steps.

    python -m benchmarks.speed.memory [FOLDER]

The memory that the volumes add is measured against the same environments with small volumes. Over a
million steps, resets included, the memory of a process should stay as it was after the first tenth.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Sequence

import numpy as np
import psutil

import armscan  # noqa: F401 - registers the environment
from armscan.envs import make_armscan_env, make_armscan_vector_env
from armscan.volumes import LabelVolume, ManipulatorAction, load_phantoms
from benchmarks.arguments import labelmaps, parser_of
from benchmarks.tables import print_head, print_row

NUM_ENVS, N_VOLUMES, N_STEPS = 64, 8, 40
RULES = {"projection": "zy", "transform": None, "success_threshold": 1.0}
# Over a million steps: volumes moved at each reset, observations stacked, the best actions remembered.
LONG_RULES = {"projection": "zy", "rotation_bounds_deg": (90.0, 45.0), "stack": 8, "memory": 4}
N_LONG_STEPS, N_LOOKS = 10**6, 10


def resident_bytes() -> int:
    """Return the resident set size of this process."""
    return psutil.Process().memory_info().rss


def small_volumes() -> list[LabelVolume]:
    """Volumes of a few kilobytes that show every landmark."""
    labels = np.zeros((40, 30, 20), dtype=np.uint8)
    labels[:15, :, :8], labels[16:28, :, 8:12], labels[30:, :, 12:] = 1, 2, 3
    plane = ManipulatorAction((0.0, 0.0), (0.0, 5.0))
    return [LabelVolume(labels, (1.0, 1.0, 1.0), f"small-{i}", plane) for i in range(N_VOLUMES)]


def bytes_when_stepping(volumes: Sequence[LabelVolume]) -> list[float]:
    """Step environments until every volume has been used; return the bytes that the process then holds."""
    envs = make_armscan_vector_env(NUM_ENVS, volumes, **RULES)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    for _ in range(N_STEPS):
        envs.step(envs.action_space.sample())
    return [float(resident_bytes())]


def in_child(measure: Callable[..., list[float]], *args: object) -> list[float]:
    """Return what a fresh process measures."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(measure, args)


def bytes_over_steps(volumes: Sequence[LabelVolume], num_envs: int) -> list[float]:
    """Take a million environment steps; return the bytes after each tenth, and the seconds of all.

    Args:
        volumes: Volumes of the environments.
        num_envs: Number of environments side by side; 1 for the single environment.
    """
    envs = make_armscan_env(volumes, **LONG_RULES)
    if num_envs > 1:
        envs = make_armscan_vector_env(num_envs, volumes, **LONG_RULES)
    envs.action_space.seed(0)
    envs.reset(seed=0)
    start_s, looks = time.perf_counter(), []
    for _ in range(N_LOOKS):
        for _ in range(N_LONG_STEPS // N_LOOKS // num_envs):
            _, _, terminated, truncated, _ = envs.step(envs.action_space.sample())
            if num_envs == 1 and (terminated or truncated):
                envs.reset()
        looks.append(float(resident_bytes()))
    return [*looks, time.perf_counter() - start_s]


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("volumes", metavar="FOLDER", type=labelmaps, nargs="?", help="default: phantoms")
    volumes = list((parser.parse_args().volumes or load_phantoms(range(N_VOLUMES))).values())
    n_voxels = sum(volume.labels.size for volume in volumes)
    print(f"{len(volumes)} volumes, {n_voxels / 2**20:.0f} MiB of voxels as uint8; {NUM_ENVS} environments\n")
    print_head("", "MiB that the volumes add", "times their voxels")
    added = in_child(bytes_when_stepping, volumes)[0] - in_child(bytes_when_stepping, small_volumes())[0]
    print_row("one process", f"{added / 2**20:.0f}", f"{added / n_voxels:.2f}")
    print()
    print_head("MiB after steps", "100,000", "500,000", "1,000,000", "most", "grown since 100,000", "minutes")
    for num_envs in (1, NUM_ENVS):
        *looks, seconds = in_child(bytes_over_steps, volumes, num_envs)
        figures = (looks[0], looks[4], looks[-1], max(looks), looks[-1] - looks[0])
        name = "one environment" if num_envs == 1 else f"{num_envs} environments side by side"
        print_row(name, *(f"{figure / 2**20:.1f}" for figure in figures), f"{seconds / 60:.1f}")


if __name__ == "__main__":
    main()

"""Count instructions and cache misses of the compiled code that looks at a plane, with Valgrind's cachegrind.

    python -m benchmarks.speed.cache_misses [--planes N]

Random planes of the default phantoms, in batches of 16, on one thread. A process looks slices up, or looks at planes,
clusters included; another one ends without planes, and its counts are subtracted before dividing by the planes.
Cachegrind simulates a first level of 32 KiB and a last level of 32 MiB, without prefetching. Takes five processes of a
minute each on a quiet machine.
"""

from __future__ import annotations

import argparse
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numba
import numpy as np
from llvmlite.binding import get_host_cpu_name
from numba.core.codegen import get_host_cpu_features

from armscan.anatomy import PIXEL_TISSUES, Scanner
from armscan.volumes import LabelVolume, load_phantoms
from armscan.volumes.rigid_transform import mapped_plane
from armscan.volumes.slicing import sample_plane
from benchmarks.arguments import count, parser_of
from benchmarks.repository import environment
from benchmarks.tables import print_head, print_row

BATCH = 16
PROJECTIONS, PARTS = ("y", "full"), ("lookup", "look")
CACHES = ("--I1=32768,8,64", "--D1=32768,8,64", "--LL=33554432,16,64")
COUNTED = {"instructions": "Ir", "first-level data misses": "D1mr D1mw", "last-level data misses": "DLmr DLmw"}
# Volumes, planes and motions of volumes, as `Scanner.look_all` takes them.
Batch = tuple[np.ndarray, np.ndarray, np.ndarray]


def main() -> None:
    """Print the table, or look at planes for another process that counts."""
    parser = parser_of(__doc__)
    parser.add_argument("--planes", type=count, default=1024, help="planes of each process (default: 1024)")
    parser.add_argument("--serve", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve(*given.serve)
        return
    if given.planes < BATCH:
        parser.error(f"--planes is {given.planes}, but it must be at least {BATCH}")
    scanner = Scanner(list(load_phantoms(range(4)).values()), PIXEL_TISSUES)
    print_head("per plane", *COUNTED, align="---:")
    idle = counts(scanner, "look", [])
    for projection in PROJECTIONS:
        batches = draw_batches(scanner.volumes, projection, given.planes // BATCH)
        for part in PARTS:
            counted = counts(scanner, part, batches)
            each = [(counted[name] - idle[name]) / (BATCH * len(batches)) for name in COUNTED]
            print_row(f"{projection}, {part}", *(f"{number:,.0f}" for number in each))


def draw_batches(volumes: Sequence[LabelVolume], projection: str, n_batches: int) -> list[Batch]:
    """Return the planes of random actions, in volumes that are moved as at resets."""
    # Not needed by the processes that are counted.
    from armscan.envs import RandomTransform
    from armscan.envs.actions import ActionBounds, free_components

    rng, free = np.random.default_rng(0), list(free_components(projection))

    def draw(volume: LabelVolume) -> tuple[np.ndarray, np.ndarray]:
        assert volume.optimal_action is not None
        motion, bounds = RandomTransform().draw(volume, rng), ActionBounds((180.0, 180.0), volume.size_mm[:2])
        normalised = bounds.normalised(motion.inverse_plane(volume.optimal_action))
        normalised[free] = rng.uniform(-1.0, 1.0, len(free))
        return bounds.denormalise(normalised.tolist()).to_array(), motion.maps

    drawn = rng.integers(len(volumes), size=(n_batches, BATCH))
    planes = [[draw(volumes[i]) for i in which] for which in drawn]
    return [
        (which, np.array([plane for plane, _ in each]), np.array([maps for _, maps in each]))
        for which, each in zip(drawn, planes, strict=True)
    ]


def counts(scanner: Scanner, part: str, batches: list[Batch]) -> dict[str, int]:
    """Return what cachegrind counts in a process that looks at planes."""
    # Valgrind's processor has another name, for which Numba would recompile everything.
    numba_env = {"NUMBA_CPU_NAME": get_host_cpu_name(), "NUMBA_CPU_FEATURES": get_host_cpu_features()}
    with tempfile.TemporaryDirectory() as folder:
        path, given = Path(folder, "counts"), Path(folder, "given")
        given.write_bytes(pickle.dumps((scanner, draw_batches(scanner.volumes, "y", 1), batches)))
        serve(part, str(given))  # Compiles what is not in Numba's cache yet.
        valgrind = ["valgrind", "-q", "--tool=cachegrind", "--cache-sim=yes", f"--cachegrind-out-file={path}", *CACHES]
        subprocess.run(
            [*valgrind, sys.executable, "-m", "benchmarks.speed.cache_misses", "--serve", part, str(given)],
            env=environment(NUMBA_NUM_THREADS="1", **numba_env),
            check=True,
        )
        lines = path.read_text().splitlines()
    written = dict(line.split(": ") for line in lines if line.startswith(("events: ", "summary: ")))
    totals = dict(zip(written["events"].split(), map(int, written["summary"].split()), strict=True))
    return {name: sum(totals[event] for event in of.split()) for name, of in COUNTED.items()}


def serve(part: str, given: str) -> None:
    """Look at a first batch in both ways, then at the others in one."""
    scanner, first, batches = pickle.loads(Path(given).read_bytes())
    arrays = numba.typed.List([(volume.labels_yxz, volume.occupied) for volume in scanner.volumes])
    spacings_mm = np.array([volume.spacing for volume in scanner.volumes])
    slice_xz = np.empty(scanner.volumes[0].slice_shape, dtype=np.uint8)
    ways = {
        "lookup": lambda batch: look_up(arrays, spacings_mm, *batch, slice_xz),
        "look": lambda batch: scanner.look_all(*batch),
    }
    for look in ways.values():
        look(*first)
    for batch in batches:
        ways[part](batch)


@numba.njit(cache=True)
def look_up(
    volumes: Sequence[tuple[np.ndarray, np.ndarray]],
    spacings_mm: np.ndarray,
    which: np.ndarray,
    planes: np.ndarray,
    maps: np.ndarray,
    slice_xz: np.ndarray,
) -> None:
    """Look slices up without clustering them, each into the same array."""
    for i in range(which.size):
        (rz, rx, tx, ty), (s_x, s_y, s_z) = planes[i], spacings_mm[which[i]]
        matrix, offset_mm = mapped_plane(maps[i], (rz, rx), (tx, ty))
        labels_yxz, occupied = volumes[which[i]]
        sample_plane(labels_yxz, occupied, (s_x, s_y, s_z), matrix, offset_mm, slice_xz)


if __name__ == "__main__":
    main()

"""Compare the anatomy of labelmaps and phantoms: positions of bones, tendons, artery and nerve along the arm.

    python -m benchmarks.learning.profiles FOLDER [--phantoms N]

Every wrist is sliced every millimetre, parallel to its labelled plane, from 40 mm towards the fingers (negative) to
45 mm towards the elbow. Prints for each landmark its range in the folder, its range in N phantoms of each version
(default: 64), and how many of the folder's wrists lie inside the latter. Across, positive is ulnar, where the artery
is; in depth, palmar.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from armscan.anatomy import TissueClusters
from armscan.training.splits import TEST_FIRST_SEED
from armscan.volumes import LabelVolume, make_phantom, read_dataset
from armscan.volumes.phantom import VERSIONS
from benchmarks.arguments import count, parser_of, run_script
from benchmarks.tables import print_head, print_row

PLACES_MM = np.arange(-40, 46)
BONE, TENDON, ARTERY, NERVE = 1, 2, 3, 4
# Fewer pixels of a tissue are strays.
MIN_PIXELS = 12


def profile(volume: LabelVolume) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return area (mm2) and mean position (across, depth, in mm) of each tissue, and number of tendon clusters.

    Shapes: (n, 4), (n, 4, 2), (n,), for each of `PLACES_MM` along the arm; positions are NaN where a tissue is absent.
    """
    labelled = volume.optimal_action
    tx_mm, ty_mm = labelled.translation
    areas, places, n_tendons = [], [], []
    for along_mm in PLACES_MM:
        plane = replace(labelled, translation=(tx_mm, ty_mm + along_mm / labelled.normal[1]))
        slice_xz = volume.slice(plane)
        aside_mm = plane.offset_mm @ plane.matrix[:, 0]
        where = [np.argwhere(slice_xz == tissue) for tissue in (BONE, TENDON, ARTERY, NERVE)]
        areas.append([len(pixels) for pixels in where])
        places.append([_mean_mm(pixels, volume.pixel_mm, aside_mm) for pixels in where])
        n_tendons.append(len(TissueClusters.from_slice(slice_xz, pixel_mm=volume.pixel_mm).tendons))
    return np.array(areas) * np.prod(volume.pixel_mm), np.array(places), np.array(n_tendons)


def _mean_mm(pixels: np.ndarray, pixel_mm: tuple[float, float], aside_mm: float) -> np.ndarray:
    if len(pixels) < MIN_PIXELS:
        return np.full(2, np.nan)
    return pixels.mean(axis=0) * pixel_mm + (aside_mm, 0.0)


def landmarks(volume: LabelVolume) -> dict[str, float]:
    """Return where the landmarks of a wrist lie, by name."""
    areas, places, n_tendons = profile(volume)
    here = PLACES_MM.tolist().index(0)
    bones = areas[:, 0]
    from_tendons = places - places[here, 1]
    ulnar = np.sign(from_tendons[here, 2, 0])

    def least(low_mm: float, high_mm: float) -> tuple[int, float]:
        """Return the index of the plane with the least bone, and its place; NaN at a limit, beyond which it may lie."""
        within = np.flatnonzero((low_mm <= PLACES_MM) & (high_mm >= PLACES_MM))
        index = int(within[bones[within].argmin()])
        return index, math.nan if index in within[[0, -1]] else float(PLACES_MM[index])

    def first(tissue: int) -> float:
        return float(PLACES_MM[np.flatnonzero(np.isfinite(places[:, tissue - 1, 0]))[0]])

    is_grouped = n_tendons == 3
    joined = here + int(np.argmin(is_grouped[here:]))
    parted = here - int(np.argmin(is_grouped[here::-1]))
    (to_hand, hand_mm), (to_proximal, proximal_mm) = least(-20, -6), least(2, 16)
    _, forearm_mm = least(PLACES_MM[to_proximal] + 9, 33)
    beyond, row, arm = (PLACES_MM.tolist().index(mm) for mm in (-30, 0, 40))
    found = {
        "tendons: three groups from, mm": PLACES_MM[parted] + 1,
        "tendons: three groups to, mm": PLACES_MM[joined] - 1,
        "tendons: middle of the groups, mm": (PLACES_MM[parted] + PLACES_MM[joined]) / 2,
        "tendons: bundle aside at 20 mm, mm": ulnar * from_tendons[here + 20, 1, 0],
        "bones: gap to the metacarpals, mm": hand_mm,
        "bones: gap between the rows, mm": proximal_mm,
        "bones: gap to the forearm, mm": forearm_mm,
        "bones: area in the gap between the rows, mm2": bones[to_proximal],
        "bones: middle of the distal row, mm": np.average(
            PLACES_MM[to_hand:to_proximal], weights=bones[to_hand:to_proximal]
        ),
        "bones: area of the metacarpals at -30 mm, mm2": bones[beyond],
        "bones: area at the labelled plane, mm2": bones[row],
        "bones: area of the forearm at 40 mm, mm2": bones[arm],
        "bones: depth from the tendons at the labelled plane, mm": from_tendons[row, 0, 1],
        "bones: depth of the forearm from the tendons, mm": from_tendons[arm, 0, 1],
        "artery: begins, mm": first(ARTERY),
        "artery: across from the tendons, mm": abs(from_tendons[here, 2, 0]),
        "artery: depth from the tendons, mm": from_tendons[here, 2, 1],
    }
    if areas[:, 3].any():
        found |= {
            "nerve: begins, mm": first(NERVE),
            "nerve: across from the tendons, mm": ulnar * from_tendons[here, 3, 0],
            "nerve: depth from the tendons, mm": from_tendons[here, 3, 1],
        }
    return {name: float(value) for name, value in found.items()}


def ranges(volumes: Iterable[LabelVolume]) -> dict[str, np.ndarray]:
    """Return the landmarks of all wrists by name, NaN where a wrist has none."""
    found = [landmarks(volume) for volume in volumes]
    return {name: np.array([each.get(name, np.nan) for each in found]) for each in found for name in each}


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("data")
    parser.add_argument("--phantoms", type=count, default=64)
    given = parser.parse_args()
    ours = ranges(read_dataset(given.data).values())
    seeds = range(TEST_FIRST_SEED, TEST_FIRST_SEED + given.phantoms)
    theirs = [ranges(make_phantom(seed, version) for seed in seeds) for version in VERSIONS]
    print_head("", given.data, *(column for version in VERSIONS for column in (f"version {version}", "inside")))
    for name, values in ours.items():
        cells = [f"{np.nanmin(values):.1f} to {np.nanmax(values):.1f}"]
        for each in theirs:
            low, high = np.nanmin(each[name]), np.nanmax(each[name])
            n_inside = int(((low <= values) & (values <= high)).sum())
            cells += [f"{low:.1f} to {high:.1f}", f"{n_inside} of {np.isfinite(values).sum()}"]
        print_row(name, *cells)


if __name__ == "__main__":
    run_script(main)

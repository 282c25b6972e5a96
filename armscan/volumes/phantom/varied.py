"""Phantoms of version 2: wrists whose parts vary in position relative to each other and to the labelled plane.

Where the carpal rows end, how wide the gaps between them are, where tendons split and merge, and what the labelled
plane cuts, differ between sources of labelmaps; in version 1 all of it is fixed to within a millimetre. Here the parts
of such a wrist are shifted against each other along the arm, across and in depth, stretched, bent, thickened or
thinned. In every one the labelled plane cuts the four bones of the distal row, and lies near the middle of the stretch
in which tendons run in three groups.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armscan.utils.arrays import FloatArray
from armscan.volumes.phantom.tube import RADIUS_X, Tube, X, Y, Z
from armscan.volumes.phantom.wrist import draw_parts

# Of version 1, in mm along the arm: half length of the distal row, middle and half length of the proximal one, where
# the long bones on either side begin, and where tendons split and merge.
DISTAL_HALF, PROXIMAL_MIDDLE, PROXIMAL_HALF, HAND, FOREARM = 11.2, 18.3, 6.4, -14.3, 27.0
TENDONS_PART, TENDONS_JOIN = -8.2, 6.6
# The distal row ends no nearer to the labelled plane than this.
MIN_END_MM = 3.0


def draw_varied_wrist(rng: np.random.Generator) -> list[Tube]:
    """Draw the anatomy of one right wrist of version 2; bones come first, so that nothing cuts into them."""
    parts = draw_parts(rng)
    bones = _bones(rng, parts)
    while not _are_cut_as_labelled(bones):
        bones = _bones(rng, parts)
    all_bones = [tube for tubes in bones.values() for tube in tubes]
    tubes = [*all_bones, *_tendons(rng, parts["tendons"]), *_vessel_and_nerve(rng, parts["vessel and nerve"])]
    hand, forearm = rng.normal((-0.04, 0.0), (0.05, 0.03)), rng.normal(0.0, 0.02, 2)
    return [_bent(tube, hand, forearm) for tube in tubes]


EVEN = np.ones(2)


class _Place(NamedTuple):
    """Place and thickness of a part's tubes, as arguments of `Tube.arrange`.

    `spread_mm` is the standard deviation (x, y, z) in mm of each tube's own shift.
    """

    shift_mm: tuple[float, float, float]
    stretch: tuple[float, float, float]
    thickness: FloatArray = EVEN
    spread_mm: tuple[float, float, float] = (0.3, 0.8, 0.6)

    def arrange(self, rng: np.random.Generator, tubes: list[Tube]) -> list[Tube]:
        """Return the tubes in this place, each with a shift and thickness of its own."""
        return [
            tube.arrange(
                shift_mm=rng.normal(self.shift_mm, self.spread_mm),
                stretch=self.stretch,
                thickness=self.thickness * rng.uniform(0.95, 1.05),
            )
            for tube in tubes
        ]


def _bones(rng: np.random.Generator, parts: dict[str, list[Tube]]) -> dict[str, list[Tube]]:
    """Return all bones by part: carpal rows of random position and length, long bones at random distances from them."""
    half, middle = rng.uniform(7.5, 12.5), rng.uniform(-7.0, 1.5)
    middle = max(middle, MIN_END_MM - half)
    proximal_start, proximal_half = middle + half + rng.uniform(-2.5, 1.5), rng.uniform(5.5, 8.5)
    hand = middle - half - rng.uniform(0.0, 4.0) - HAND
    forearm = proximal_start + 2 * proximal_half + rng.uniform(-3.0, 4.0) - FOREARM
    distal, proximal = half / DISTAL_HALF, proximal_half / PROXIMAL_HALF
    proximal_shift = proximal_start + proximal_half - PROXIMAL_MIDDLE * proximal
    across, apart, deep = rng.uniform(0.94, 1.06), rng.uniform(0.95, 1.35), rng.uniform(-0.7, 1.5)
    thick = rng.uniform((0.9, 0.85), (1.0, 1.15))
    hook = _Place((0.0, middle, deep), (across, distal * rng.uniform(0.5, 1.0), 1.0), rng.uniform(0.9, 1.4, 2))
    in_joints = (0.0, 0.4, 0.3)
    of_fingers = rng.uniform(1.0, 1.7)
    places = {
        "distal row": _Place((0.0, middle, deep), (across, distal, 1.0), thick),
        "proximal row": _Place(
            (0.0, proximal_shift, deep), (across, proximal, 1.0), rng.uniform((0.9, 0.9), (1.15, 1.25))
        ),
        "proximal accessory": _Place((0.0, proximal_shift, deep), (across, proximal, 1.0)),
        "accessory": _Place((0.0, hand, deep), (across, 1.0, 1.0)),
        "fingers": _Place((0.0, hand, deep), (across, 1.0, 1.0), of_fingers * rng.uniform(0.9, 1.1, 2), in_joints),
        "forearm": _Place(
            (0.0, forearm, deep + rng.uniform(-0.5, 2.0)), (apart, 1.0, 1.0), rng.uniform(0.95, 1.35, 2), in_joints
        ),
    }
    *row, of_hook = parts["distal row"]
    n_beyond = len(parts["accessory"]) // 2
    tubes = parts | {
        "distal row": row,
        "accessory": parts["accessory"][:n_beyond],
        "proximal accessory": parts["accessory"][n_beyond:],
    }
    placed = {name: place.arrange(rng, tubes[name]) for name, place in places.items()}
    return {**placed, "hook": hook.arrange(rng, [of_hook])}


def _are_cut_as_labelled(bones: dict[str, list[Tube]]) -> bool:
    """Return whether the labelled plane cuts the four bones of the distal row and, the hook aside, no others."""
    others = [tube for name, tubes in bones.items() for tube in tubes if name not in ("distal row", "hook")]
    return min(map(_share_at_plane, bones["distal row"])) > 0.5 and max(map(_share_at_plane, others)) == 0.0


def _share_at_plane(tube: Tube) -> float:
    """Return the width of a tube at the labelled plane as a fraction of its largest width."""
    widths = tube.nodes[:, RADIUS_X]
    return float(np.interp(0.0, tube.nodes[:, Y], widths, left=0.0, right=0.0) / widths.max())


def _tendons(rng: np.random.Generator, tendons: list[Tube]) -> list[Tube]:
    """Return the tendons with a stretch of three groups of random length, at whose ends a piece may be missing."""
    half, thick = rng.uniform(7.5, 10.5), rng.uniform(0.88, 1.05)
    across, deep = rng.uniform(0.82, 1.05), rng.normal(0.0, 0.4)
    palm_mm, forearm_mm = rng.uniform(0.0, (1.5, 3.0)) * (rng.random(2) < (0.4, 0.7))
    # The forearm bundle is shifted sideways: within the gap before it, or gradually if there is none.
    aside_mm = rng.uniform(-4.0, 1.5)
    aside_from_to = (half, half + (forearm_mm or 15.0))
    ends_of_pieces = ((-90.0, -half - palm_mm), (-half, half), (half + forearm_mm, 180.0))
    pieces: list[Tube] = []
    for tendon in tendons:
        tube = tendon.arrange(shift_mm=(0.0, 0.0, deep), stretch=(across, 1.0, 1.0), thickness=(thick, thick))
        nodes = tube.nodes
        known, wanted = (
            (-90.0, -16.0, TENDONS_PART, TENDONS_JOIN, 34.0, 180.0),
            (-90.0, -16.0, -half, half, 34.0, 180.0),
        )
        nodes[:, Y] = np.interp(nodes[:, Y], known, wanted)
        nodes[:, X] += aside_mm * np.interp(nodes[:, Y], aside_from_to, (0.0, 1.0))
        pieces += [tube.between(*ends) for ends in ends_of_pieces]
    return pieces


def _vessel_and_nerve(rng: np.random.Generator, cords: list[Tube]) -> list[Tube]:
    """Return artery and nerve, shifted at random across, along the arm and in depth."""
    artery, nerve = cords
    return [
        artery.arrange(shift_mm=(rng.uniform(-5.5, 1.0), rng.uniform(-4.0, 3.0), rng.normal(0.0, 0.5))),
        nerve.arrange(
            shift_mm=(rng.uniform(-4.5, 1.0), rng.uniform(-5.0, 2.0), rng.normal(0.0, 0.4)),
            thickness=rng.uniform(0.92, 1.2, 2),
        ),
    ]


def _bent(tube: Tube, hand: FloatArray, forearm: FloatArray) -> Tube:
    """Return a tube bent where hand and forearm leave the carpus, by the tangents of their angles (across, depth)."""
    nodes = tube.nodes.copy()
    beyond_mm = (np.minimum(nodes[:, Y] + 13.0, 0.0), np.maximum(nodes[:, Y] - 25.0, 0.0))
    for axis, of_hand, of_forearm in zip((X, Z), hand, forearm, strict=True):
        nodes[:, axis] += of_hand * beyond_mm[0] + of_forearm * beyond_mm[1]
    return Tube(tube.label, nodes)

"""Make a phantom volume from a seed: draw a wrist, pose it in the field of view, and label the voxels."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_choice, check_seed
from armscan.volumes.phantom.tube import Tube, fill_tube
from armscan.volumes.phantom.varied import draw_varied_wrist
from armscan.volumes.phantom.wrist import draw_wrist
from armscan.volumes.plane import ManipulatorAction, shift_into
from armscan.volumes.volume import LabelVolume

SHAPE = (360, 800, 80)
SPACING_MM = (0.27, 0.27, 0.55)
N_STRAY_VOXELS = (150, 450)

# Functions that draw the anatomy, by version; what a version draws from a seed never changes.
VERSIONS = {1: draw_wrist, 2: draw_varied_wrist}


class Pose(NamedTuple):
    """Pose of a wrist in the field of view: (rz, rx) in degrees, its tunnel's centre in mm, scale, left or right."""

    rotation: tuple[float, float]
    origin_mm: FloatArray
    size: float
    left: bool

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Pose:
        """Draw a pose in which the whole wrist is in the field of view."""
        across_mm, along_mm, depth_mm = np.multiply(SHAPE, SPACING_MM)
        return cls(
            rotation=(rng.uniform(-15.0, 15.0), rng.uniform(-2.0, 2.0)),
            origin_mm=np.array(
                [
                    across_mm * rng.uniform(0.46, 0.54),
                    along_mm * rng.uniform(0.38, 0.72),
                    depth_mm * 0.36 + rng.normal(0.0, 0.5),
                ]
            ),
            size=rng.uniform(0.92, 1.06),
            left=bool(rng.random() < 0.5),
        )

    def place(self, tube: Tube) -> Tube:
        """Return a tube of the standard right hand, mirrored and scaled to this hand."""
        return (tube.mirror() if self.left else tube).scale(self.size)

    def optimal_action(self) -> ManipulatorAction:
        """Return the plane y = 0 of the wrist in the volume's frame, with its origin at the volume's side."""
        plane = ManipulatorAction(self.rotation, (0.0, 0.0))
        across, in_depth = plane.matrix[:, 0], plane.matrix[:, 2]
        at_floor_mm = self.origin_mm - self.origin_mm[2] / in_depth[2] * in_depth
        at_side_mm = at_floor_mm - at_floor_mm[0] / across[0] * across
        action = ManipulatorAction(self.rotation, (0.0, at_side_mm[1]))
        bounds_mm = (SHAPE[0] * SPACING_MM[0], SHAPE[1] * SPACING_MM[1])
        slid = shift_into(action, bounds_mm)
        assert slid is not None, "a pose keeps its plane inside the field of view"
        return slid


def make_phantom(seed: int, version: int = 1) -> LabelVolume:
    """Make the phantom wrist of a seed, 360 x 800 x 80 voxels of 0.27 x 0.27 x 0.55 mm.

    Args:
        seed: Seed of everything drawn: anatomy, size, pose, side (left or right), stray voxels.
        version: Version of the anatomy, one of `VERSIONS`. In version 1 the labelled plane has a fixed position among
            bones and tendons; in version 2 its position varies. Default: 1.

    Returns:
        The volume, named `phantom-SEED`, or `phantom-v2-SEED` in version 2, with its optimal plane.

    Raises:
        InvalidValueError: If the seed is not a whole number from 0 to 2^31 - 1, or there is no such version.
    """
    name = phantom_name(seed, version)
    rng = np.random.default_rng(seed)
    pose = Pose.draw(rng)
    action = pose.optimal_action()
    plane = ManipulatorAction(pose.rotation, (0.0, 0.0))
    labels = np.zeros(SHAPE, dtype=np.uint8)
    for tube in VERSIONS[version](rng):
        fill_tube(labels, SPACING_MM, plane.matrix, pose.origin_mm, pose.place(tube).nodes, tube.label)
    _scatter_strays(labels, rng)
    return LabelVolume(labels, SPACING_MM, name, optimal_action=action)


PHANTOM_NAME = re.compile(r"phantom-(v\d+-)?\d+")


def phantom_name(seed: int, version: int) -> str:
    """Return the name of a phantom.

    Raises:
        InvalidValueError: If the seed is not a whole number from 0 to 2^31 - 1, or there is no such version.
    """
    check_choice("version", version, tuple(VERSIONS))
    check_seed("seed", seed)
    return f"phantom-{seed}" if version == 1 else f"phantom-v{version}-{seed}"


def _scatter_strays(labels: np.ndarray, rng: np.random.Generator) -> None:
    """Label single background voxels at random, like slips in manual segmentation."""
    n_strays = rng.integers(*N_STRAY_VOXELS)
    where = tuple(rng.integers(0, n, n_strays) for n in labels.shape)
    strays = rng.integers(1, 4, n_strays).astype(np.uint8)
    labels[where] = np.where(labels[where] == 0, strays, labels[where])

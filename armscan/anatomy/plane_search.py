"""Search an unlabelled volume for its optimal plane: the middle of the planes that score best.

The reward is constant over whole regions of planes: there are many best planes, and the one that a person marks lies
well inside such a region. The search scores a coarse grid, then a finer one around the largest connected region of best
planes, and returns the middle of that region. It is deterministic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from armscan.anatomy.rewards import PUBLISHED_TARGETS, SUCCESS_THRESHOLD, LandmarkReward, Reward
from armscan.anatomy.scanner import Scanner
from armscan.anatomy.tissues import Tissues, check_tissues
from armscan.errors import InvalidValueError, OptimalPlaneError
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_float
from armscan.volumes.plane import ManipulatorAction, shift_into
from armscan.volumes.volume import LabelVolume

MAX_PLANES = 1_000_000
# Planes one step apart are neighbours, in one component or in several.
NEIGHBOURS = np.ones((3, 3, 3))
# Rewards that differ by rounding only are the same.
SAME_REWARD = 1e-9
ROUNDING_DEG = 1e-6
# Rotated further, a plane hardly crosses the arm.
MAX_ANGLE_DEG = 80.0


@dataclass(frozen=True)
class FoundPlane:
    """Result of a search.

    Args:
        action: Plane that was found; its origin (tx, ty) lies within the volume.
        score: Reward of the plane, in [-1, 0].
        counts: Number of clusters of bones, tendons and artery in its slice.
        spread: Extent of the largest connected region of planes with the best score, end to end: (rz, rx) in degrees
            and along the arm in mm. Default: None, for a plane that a person or an agent chose.
        is_cut: Whether that region reaches the limit of rz or rx, beyond which it may go on. Default: False.
    """

    action: ManipulatorAction
    score: float
    counts: tuple[int, int, int]
    spread: tuple[float, float, float] | None = None
    is_cut: bool = False


@dataclass(frozen=True)
class PlaneGrid:
    """A regular grid of planes; a pose (rz, rx, along) is two rotations in degrees and the slice centre's y in mm.

    Args:
        lowest: Pose of the first plane, shape (3,).
        steps: Step from one plane to the next, shape (3,).
        shape: Number of planes along each component.
    """

    lowest: FloatArray
    steps: FloatArray
    shape: tuple[int, int, int]

    @classmethod
    def between(cls, lowest: FloatArray, highest: FloatArray, steps: FloatArray) -> Self:
        """Return a grid from the lowest to the highest pose, both included, with about these steps."""
        n_steps = np.maximum(1.0, np.round((highest - lowest) / steps))
        if np.prod(n_steps + 1) > MAX_PLANES:
            raise InvalidValueError(
                f"the search would score {np.prod(n_steps + 1):.3g} planes, but at most {MAX_PLANES} are allowed: is "
                "the spacing of the volume in mm? In Python, take larger steps or smaller angles"
            )
        n_rz, n_rx, n_along = (int(n) + 1 for n in n_steps)
        return cls(lowest, (highest - lowest) / n_steps, (n_rz, n_rx, n_along))

    def finer_about(self, region: NDArray[np.int64]) -> Self:
        """Return a grid of half the steps over the bounding box of a region's planes and their neighbours."""
        first = np.maximum(region.min(axis=0) - 1, 0)
        last = np.minimum(region.max(axis=0) + 1, np.subtract(self.shape, 1))
        n_rz, n_rx, n_along = (int(n) for n in 2 * (last - first) + 1)
        return type(self)(self.pose(first), self.steps / 2, (n_rz, n_rx, n_along))

    def pose(self, index: NDArray[np.int64] | FloatArray) -> FloatArray:
        """Return the pose at an index, shape (..., 3); a fractional index lies between planes."""
        pose: FloatArray = self.lowest + index * self.steps
        return pose

    def rewards(self, scorer: PlaneScorer) -> FloatArray:
        """Return the reward of each plane; -1 if its origin cannot lie within the volume."""
        rewards = np.full(self.shape, -1.0)
        for index in np.ndindex(self.shape):
            plane = plane_at(scorer.volume, self.pose(np.array(index)))
            if plane is not None:
                rewards[index], _ = scorer.score(plane)
        return rewards


class PlaneScorer:
    """Scores planes of one volume.

    Args:
        volume: Volume of the planes.
        reward: Reward that scores them.
        tissues: Clustering rule of each tissue.
    """

    def __init__(self, volume: LabelVolume, reward: Reward, tissues: Tissues) -> None:
        self.volume = volume
        self._reward = reward
        self._scanner = Scanner([volume], tissues)

    def score(self, plane: ManipulatorAction) -> tuple[float, tuple[int, int, int]]:
        """Return the reward of a plane and the clusters of bones, tendons and artery that it shows."""
        _, landmarks = self._scanner.look(0, plane)
        bones, tendons, artery = (int(count) for count in landmarks[:, 0])
        return self._reward.score(landmarks, self.volume.pixel_mm), (bones, tendons, artery)


def find_optimal_plane(
    volume: LabelVolume,
    *,
    rz_deg: float = 45.0,
    rx_deg: float = 20.0,
    step_deg: float = 5.0,
    step_mm: float = 3.0,
    success_threshold: float = SUCCESS_THRESHOLD,
    targets: Sequence[int] = PUBLISHED_TARGETS,
    clustering: str | Tissues = "pixels",
) -> FoundPlane:
    """Find the plane in the middle of the largest connected region of planes with the best landmark reward.

    A plane that the volume is already labelled with is ignored. If the best planes extend beyond the rotation limits,
    the middle is taken of the part within.

    Args:
        volume: Volume to search, over its whole length.
        rz_deg: Largest rotation about Z to try, in degrees, in both directions, from 0 to 80. Default: 45.
        rx_deg: Largest rotation about X to try, in degrees, in both directions, from 0 to 80. Default: 20.
        step_deg: Step between rotations in the first search, in degrees, above 0; half of it around the region with the
            best score. Default: 5.
        step_mm: Step along the arm in the first search, in mm, above 0; half of it around the region with the best
            score. Default: 3.
        success_threshold: Threshold of success: a plane counts as found if it scores above -success_threshold. Default:
            0.05.
        targets: Target counts of the reward, each from 1 to 1000. Default: (4, 3, 1).
        clustering: Clustering rules: `pixels`, `metric`, or an `armscan.anatomy.Tissues`. Default: `pixels`.

    Returns:
        The plane with its score.

    Raises:
        InvalidValueError: If an argument is out of bounds, or more than a million planes would be tried.
        OptimalPlaneError: If no plane scores above -success_threshold; the message names the best score.
    """
    if not isinstance(volume, LabelVolume):
        raise InvalidValueError(f"volume is {volume!r}, but it must be a LabelVolume")
    scorer = PlaneScorer(volume, LandmarkReward(targets), check_tissues(clustering))
    check_float("success_threshold", success_threshold, above=0.0, at_most=1.0)
    rz, rx = (
        check_float(name, limit, at_least=0.0, at_most=MAX_ANGLE_DEG)
        for name, limit in (("rz_deg", rz_deg), ("rx_deg", rx_deg))
    )
    turn, shift = check_float("step_deg", step_deg, above=0.0), check_float("step_mm", step_mm, above=0.0)
    last_mm = 2 * volume.centre_mm[1]

    coarse = PlaneGrid.between(np.array([-rz, -rx, 0.0]), np.array([rz, rx, last_mm]), np.array([turn, turn, shift]))
    rewards = coarse.rewards(scorer)
    if rewards.max() <= -success_threshold:
        raise OptimalPlaneError(
            f"{volume.name}: no plane of {rewards.size} scores above -success_threshold = {-success_threshold:g}; "
            f"the best score found is {rewards.max():.3f}"
        )
    fine = coarse.finer_about(largest_best_region(rewards))
    fine_rewards = fine.rewards(scorer)
    region = largest_best_region(fine_rewards)

    # The middle of a region that is not convex can lie outside it: then its nearest plane is taken.
    middle = region.mean(axis=0)
    nearest = region[np.linalg.norm(region - middle, axis=1).argmin()]
    planes = [plane for index in (middle, nearest) if (plane := plane_at(volume, fine.pose(index))) is not None]
    plane = max(planes, key=lambda plane: scorer.score(plane)[0] >= fine_rewards.max() - SAME_REWARD)
    score, counts = scorer.score(plane)
    spread_rz, spread_rx, spread_along = (float(width) for width in np.ptp(region, axis=0) * fine.steps)
    is_cut = bool((np.abs(fine.pose(region)[:, :2]) >= np.array([rz, rx]) - ROUNDING_DEG).any())
    return FoundPlane(plane, score, counts, (spread_rz, spread_rx, spread_along), is_cut)


def largest_best_region(rewards: FloatArray) -> NDArray[np.int64]:
    """Return the indices, shape (n, 3), of the largest connected region of planes that score best."""
    from scipy import ndimage

    regions, _ = ndimage.label(rewards >= rewards.max() - SAME_REWARD, NEIGHBOURS)
    largest = np.bincount(regions.ravel())[1:].argmax() + 1
    return np.argwhere(regions == largest)


def plane_at(volume: LabelVolume, pose: FloatArray) -> ManipulatorAction | None:
    """Return the plane of a pose, its slice centred on the volume across; None if its origin cannot lie within it."""
    rz, rx, along_mm = (float(component) for component in pose)
    turned = ManipulatorAction((rz, rx), (0.0, 0.0))
    centre_x, _, centre_z = volume.centre_mm
    slice_centre = turned.matrix @ np.array([centre_x, 0.0, centre_z])
    action = ManipulatorAction((rz, rx), (centre_x - slice_centre[0], along_mm - slice_centre[1]))
    return shift_into(action, volume.size_mm[:2])

"""Pictures of a plane, in an episode or outside one: its slice, its position, its reward."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from armscan.anatomy import PIXEL_TISSUES, LandmarkReward, Scanner, Tissues
from armscan.envs.episode import Episode
from armscan.envs.observations import SliceGeometry, View
from armscan.envs.panels import (
    BACKGROUND,
    FAINT_COLOUR,
    OPTIMUM_COLOUR,
    PLANE_COLOUR,
    TEXT_COLOUR,
    TISSUE_COLOURS,
    font,
    is_right_handed,
    reward_panel,
    side_panels,
    slice_panel,
)
from armscan.volumes import LABEL_NAMES, LabelVolume
from armscan.volumes.plane import ManipulatorAction, plane_distance
from armscan.volumes.rigid_transform import RigidTransform

WIDTH, HEIGHT = 860, 512
# (left, top, right, bottom)
SLICE_BOX = (16, 40, 532, 276)
FRONTAL_BOX = (548, 40, 738, 496)
SAGITTAL_BOX = (754, 40, 844, 496)
REWARD_BOX = (300, 314, 532, 464)
FACTS_AT, FACTS_WIDTH = (16, 288), 276
LEGEND_AT = (16, 474)
TITLE_GAP = 7

Box = tuple[int, int, int, int]


class ReferencePlane(NamedTuple):
    """Another plane to draw beside the current one, and its name, such as `optimal plane`."""

    action: ManipulatorAction
    name: str


class RewardHistory(NamedTuple):
    """Rewards up to the current plane, each in [-1, 0], the numbers on the horizontal axis, the goal, and a title."""

    rewards: Sequence[float]
    places: range
    threshold: float
    title: str


def draw_frame(episode: Episode) -> NDArray[np.uint8]:
    """Draw the current state of an episode, whose first plane has been looked at, shape (512, 860, 3)."""
    scene, rules = episode.scene, episode.rules
    return draw_plane(
        scene.volume,
        episode.plane,
        episode.view,
        transform=scene.transform,
        reference=ReferencePlane(scene.optimum, "optimal plane"),
        history=RewardHistory(episode.rewards, range(rules.max_steps + 1), -rules.success_threshold, "reward by step"),
        caption=f"step {episode.n_steps}",
    )


def draw_plane(
    volume: LabelVolume,
    plane: ManipulatorAction,
    view: View,
    *,
    transform: RigidTransform | None = None,
    reference: ReferencePlane | None = None,
    history: RewardHistory | None = None,
    caption: str = "",
) -> NDArray[np.uint8]:
    """Draw a plane: its slice, the volume from two sides, its reward.

    Args:
        volume: Volume that the plane lies in.
        plane: Plane to draw, in the frame of the moved volume.
        view: Slice at the plane, with its clusters.
        transform: Motion of the volume. Default: None, no motion.
        reference: Another plane to draw, and to measure the distance from. Default: None.
        history: Rewards up to this plane. Default: None, not drawn.
        caption: Text before the reward. Default: none.

    Returns:
        The picture, shape (512, 860, 3).
    """
    picture = Image.new("RGB", (WIDTH, HEIGHT), BACKGROUND)
    draw = ImageDraw.Draw(picture)
    planes = [] if reference is None else [(reference.action, OPTIMUM_COLOUR, 1)]
    planes.append((plane, PLANE_COLOUR, 2))
    axes, _ = (transform or RigidTransform()).plane_map(plane)
    # With fingers at low Y, as in phantoms. A plane turned by more than 90°, or mirrored, shows its other side.
    is_front = np.cross(axes[:, 0], axes[:, 2])[1] < 0.0
    seen_from = "fingers" if is_right_handed(volume) == is_front else "elbow"
    up = "palm" if volume.has_palm_at_high_z else "back of the hand"
    frontal, sagittal = side_panels(volume, transform, planes, (_size_of(FRONTAL_BOX), _size_of(SAGITTAL_BOX)))
    for box, title, panel in (
        (SLICE_BOX, f"slice, {up} up, from the {seen_from}", slice_panel(view, _size_of(SLICE_BOX))),
        (FRONTAL_BOX, f"frontal, from the {up}", frontal),
        (SAGITTAL_BOX, "sagittal", sagittal),
    ):
        _place(picture, draw, box, title, panel)
    if history is not None:
        panel = reward_panel(history.rewards, history.places, history.threshold, _size_of(REWARD_BOX))
        _place(picture, draw, REWARD_BOX, history.title, panel)
        goal_at = REWARD_BOX[2], REWARD_BOX[1] - TITLE_GAP
        draw.text(goal_at, f"goal: above {history.threshold:g}", fill=TEXT_COLOUR, font=font(14), anchor="rs")
    is_moved = transform is not None and transform != RigidTransform()
    _write_facts(draw, volume, plane, view, is_moved=is_moved, reference=reference, caption=caption)
    _write_legend(draw, reference)
    return np.asarray(picture)


def view_of(volume: LabelVolume, plane: ManipulatorAction, *, tissues: Tissues = PIXEL_TISSUES) -> View:
    """Look at a plane of an unmoved volume, outside an episode.

    Args:
        volume: Volume to look at.
        plane: Plane in the volume's frame.
        tissues: Clustering rule of each tissue. Default: `PIXEL_TISSUES`.

    Returns:
        View of the plane, with the published reward and an empty `action`.
    """
    slice_xz, landmarks = Scanner([volume], tissues).look(0, plane)
    return View(
        slice_xz=slice_xz,
        landmarks=landmarks,
        tissues=tissues,
        geometry=SliceGeometry(volume.slice_shape, volume.pixel_mm),
        smallest_shape=volume.slice_shape,
        action=np.zeros(0),
        reward=LandmarkReward().score(landmarks, volume.pixel_mm),
    )


def _size_of(box: Box) -> tuple[int, int]:
    return box[2] - box[0], box[3] - box[1]


def _place(picture: Image.Image, draw: ImageDraw.ImageDraw, box: Box, title: str, panel: Image.Image) -> None:
    draw.text((box[0], box[1] - TITLE_GAP), title, fill=FAINT_COLOUR, font=font(14), anchor="ls")
    picture.paste(panel, box[:2])


def _write_facts(
    draw: ImageDraw.ImageDraw,
    volume: LabelVolume,
    plane: ManipulatorAction,
    view: View,
    *,
    is_moved: bool,
    reference: ReferencePlane | None,
    caption: str,
) -> None:
    x, y = FACTS_AT
    heading = f"{caption}    reward {view.reward:.3f}" if caption else f"reward {view.reward:.3f}"
    draw.text((x, y), heading, fill=TEXT_COLOUR, font=font(22))
    bones, tendons, artery = view.clusters.counts
    rz, rx, tx, ty = plane.to_array()
    lines = [
        volume.name,
        f"clusters: bones {bones}, tendons {tendons}, artery {artery}",
        f"{'in the moved volume: ' if is_moved else ''}rz {rz:.1f}°, rx {rx:.1f}°",
        f"tx {tx:.1f} mm, ty {ty:.1f} mm",
    ]
    if reference is not None:
        distance_mm, distance_deg = plane_distance(plane, reference.action, volume.slice_centre_mm)
        lines += [f"{distance_mm:.1f} mm and {distance_deg:.1f}°", f"from the {reference.name}"]
    for row, line in enumerate(lines):
        draw.text((x, y + 38 + 22 * row), _shortened(line), fill=TEXT_COLOUR, font=font(15))


def _shortened(line: str) -> str:
    """Return a line shortened in its middle, as a long file name may need, to fit beside the rewards."""
    n_kept = len(line)
    shortened = line
    while font(15).getlength(shortened) > FACTS_WIDTH:
        n_kept -= 1
        shortened = line[: n_kept // 2] + "…" + line[len(line) - n_kept // 2 :]
    return shortened


def _write_legend(draw: ImageDraw.ImageDraw, reference: ReferencePlane | None) -> None:
    x, y = LEGEND_AT
    legend = [("current plane", PLANE_COLOUR)] + ([(reference.name, OPTIMUM_COLOUR)] if reference else [])
    legend += [(name, tuple(TISSUE_COLOURS[label].tolist())) for label, name in LABEL_NAMES.items() if label > 0]
    for text, colour in legend:
        draw.text((x, y), text, fill=colour, font=font(15))
        x += 16 + round(font(15).getlength(text))

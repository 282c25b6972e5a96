"""Pictures of an episode: the slice, the plane in the volume from two sides, the reward and the step."""

from __future__ import annotations

from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from armscan.envs.observations import View
from armscan.envs.scene import Scene
from armscan.volumes.plane import FloatArray, ManipulatorAction, RigidTransform
from armscan.volumes.volume import LABEL_NAMES, LabelVolume

WIDTH, HEIGHT = 860, 480
SLICE_BOX = (16, 48, 532, 292)
FRONTAL_BOX = (548, 48, 738, 464)
SAGITTAL_BOX = (754, 48, 844, 464)
TEXT_BOX = (16, 312)

BACKGROUND = (18, 20, 26)
INK = (226, 230, 238)
FAINT_INK = (140, 148, 162)
PLANE_INK = (255, 214, 64)
OPTIMUM_INK = (96, 222, 255)
# Background, bones, tendons, artery, nerve.
TISSUE_INKS = np.array([(34, 38, 48), (224, 214, 190), (72, 178, 118), (226, 74, 70), (168, 138, 220)], dtype=np.uint8)
UNCLUSTERED = 0.45

Box = tuple[int, int, int, int]
# Drawn once a volume, and forgotten with it.
_PROJECTIONS: WeakKeyDictionary[LabelVolume, tuple[NDArray[np.uint8], NDArray[np.uint8]]] = WeakKeyDictionary()


def draw_frame(scene: Scene, plane: ManipulatorAction, view: View, n_steps: int) -> NDArray[np.uint8]:
    """Draws one step of an episode.

    Args:
        scene: the episode's volume.
        plane: the current plane.
        view: what it shows.
        n_steps: steps taken so far.

    Returns:
        The picture, shape (480, 860, 3).
    """
    picture = Image.new("RGB", (WIDTH, HEIGHT), BACKGROUND)
    draw = ImageDraw.Draw(picture)
    _title(draw, SLICE_BOX, "slice")
    _title(draw, FRONTAL_BOX, "from the palm")
    _title(draw, SAGITTAL_BOX, "from the side")
    across_mm, along_mm, depth_mm = scene.volume.size_mm
    # Rows of the slice's picture run from the palm, at high z, to the back of the hand.
    slice_mm = (view.geometry.shape[0] * view.geometry.pixel_mm[0], view.geometry.shape[1] * view.geometry.pixel_mm[1])
    picture.paste(_fitted(_slice_inks(view).transpose(1, 0, 2)[::-1], SLICE_BOX, slice_mm), SLICE_BOX[:2])
    frontal, sagittal = _projections(scene.volume)
    picture.paste(_with_planes(frontal, FRONTAL_BOX, (across_mm, along_mm), scene, plane, (0, 1)), FRONTAL_BOX[:2])
    picture.paste(_with_planes(sagittal, SAGITTAL_BOX, (depth_mm, along_mm), scene, plane, (2, 1)), SAGITTAL_BOX[:2])
    _write_facts(draw, scene, plane, view, n_steps)
    return np.asarray(picture)


def _slice_inks(view: View) -> NDArray[np.uint8]:
    """Colours a slice by tissue, shape (across, depth, 3); landmark pixels outside every cluster are darker."""
    inks = TISSUE_INKS[view.slice_xz]
    clustered = np.any([tissue.image > 0 for tissue in view.clusters.each()], axis=0)
    dark = (view.slice_xz > 0) & (view.slice_xz < 4) & ~clustered
    inks[dark] = (inks[dark] * UNCLUSTERED).astype(np.uint8)
    return inks


def _projections(volume: LabelVolume) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The volume seen from the palm, (along, across, 3), and from the side, (along, depth, 3), fingers up."""
    if volume not in _PROJECTIONS:
        _PROJECTIONS[volume] = _projected(volume)
    return _PROJECTIONS[volume]


def _projected(volume: LabelVolume) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    from_palm = np.where(volume.labels.any(axis=2), _first_seen(volume.labels[:, :, ::-1], 2), 0)
    from_side = np.where(volume.labels.any(axis=0), _first_seen(volume.labels, 0), 0)
    return TISSUE_INKS[from_palm.T], TISSUE_INKS[from_side]


def _first_seen(labels_xyz: NDArray[np.uint8], axis: int) -> NDArray[np.uint8]:
    """The first label that is not background along an axis."""
    first = np.expand_dims((labels_xyz > 0).argmax(axis=axis), axis)
    return np.take_along_axis(labels_xyz, first, axis).squeeze(axis)


def _with_planes(
    inks: NDArray[np.uint8],
    box: Box,
    size_mm: tuple[float, float],
    scene: Scene,
    plane: ManipulatorAction,
    axes: tuple[int, int],
) -> Image.Image:
    """A projection of the volume with the outlines of the optimal and the current plane."""
    picture = _fitted(inks, box, size_mm)
    draw = ImageDraw.Draw(picture)
    scale = np.array([picture.width, picture.height]) / size_mm
    for action, ink, width in ((scene.optimum, OPTIMUM_INK, 1), (plane, PLANE_INK, 2)):
        corners = _corners_mm(scene, action)[:, axes] * scale
        draw.line([(x, y) for x, y in (*corners, corners[0])], fill=ink, width=width)
    return picture


def _corners_mm(scene: Scene, action: ManipulatorAction) -> FloatArray:
    """The four corners of a slice where they lie in the volume as it was read, shape (4, 3)."""
    matrix, offset_mm = (scene.transform or RigidTransform()).plane_map(action)
    across_mm, _, depth_mm = scene.volume.size_mm
    corners = np.array([[0, 0, 0], [across_mm, 0, 0], [across_mm, 0, depth_mm], [0, 0, depth_mm]])
    return corners @ matrix.T + offset_mm


def _fitted(inks: NDArray[np.uint8], box: Box, size_mm: tuple[float, float]) -> Image.Image:
    """Scales colours, shape (rows, columns, 3), to the largest picture of true proportions that fits a box."""
    room = (box[2] - box[0], box[3] - box[1])
    scale = min(room[0] / size_mm[0], room[1] / size_mm[1])
    shape = (max(1, round(size_mm[0] * scale)), max(1, round(size_mm[1] * scale)))
    return Image.fromarray(np.ascontiguousarray(inks)).resize(shape, Image.Resampling.NEAREST)


@lru_cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _title(draw: ImageDraw.ImageDraw, box: Box, text: str) -> None:
    draw.text((box[0], box[1] - 24), text, fill=FAINT_INK, font=_font(15))


def _write_facts(draw: ImageDraw.ImageDraw, scene: Scene, plane: ManipulatorAction, view: View, n_steps: int) -> None:
    x, y = TEXT_BOX
    distance_mm, distance_deg = scene.distance(plane)
    bones, tendons, artery = view.clusters.counts
    rz, rx, tx, ty = plane.to_array()
    draw.text((x, y), f"step {n_steps}    reward {view.reward:.3f}", fill=INK, font=_font(24))
    lines = (
        f"{scene.volume.name}:  clusters: bones {bones}, tendons {tendons}, artery {artery}",
        f"rz {rz:.1f}°, rx {rx:.1f}°,  tx {tx:.1f} mm, ty {ty:.1f} mm",
        f"{distance_mm:.1f} mm and {distance_deg:.1f}° from the optimal plane",
    )
    for row, line in enumerate(lines):
        draw.text((x, y + 42 + 24 * row), line, fill=INK, font=_font(16))
    legend = [("current plane", PLANE_INK), ("optimal plane", OPTIMUM_INK)]
    legend += [(name, tuple(TISSUE_INKS[label])) for label, name in LABEL_NAMES.items() if label > 0]
    for text, ink in legend:
        draw.text((x, y + 124), text, fill=ink, font=_font(15))
        x += 16 + round(_font(15).getlength(text))

"""The parts of an episode's picture: the slice with its clusters, the volume from two sides, the rewards so far."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from armscan.envs.observations import View
from armscan.utils.arrays import FloatArray
from armscan.volumes import LANDMARK_LABELS
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.rigid_transform import RigidTransform
from armscan.volumes.volume import LabelVolume

BACKGROUND = (18, 20, 26)
TEXT_COLOUR = (226, 230, 238)
FAINT_COLOUR = (140, 148, 162)
LINE_COLOUR = (62, 68, 82)
PLANE_COLOUR = (255, 214, 64)
OPTIMUM_COLOUR = (96, 222, 255)
REWARD_COLOUR = (255, 150, 80)
# Background, bones, tendons, artery, nerve.
TISSUE_COLOURS = np.array(
    [(34, 38, 48), (224, 214, 190), (72, 178, 118), (226, 74, 70), (168, 138, 220)], dtype=np.uint8
)
# Shades of the tissue's colour for clusters 1, 2, 3, 4, repeated for further ones.
SHADES = (1.0, 0.84, 0.92, 0.76)
UNCLUSTERED = 0.45
OUTLINE_COLOUR = (255, 255, 255)
NUMBER_COLOUR = (12, 14, 18)
# In pixels of the picture: a smaller cluster would be hidden under its number.
MIN_NUMBERED = 300

ColourImage = NDArray[np.uint8]
Pixel = TypeVar("Pixel", bound=np.generic)
Colour = tuple[int, int, int]
Size = tuple[int, int]
# Views from high z, (along, across, 3), and the side, (along, depth, 3): drawn once per volume, and freed with it.
_SIDES: WeakKeyDictionary[LabelVolume, tuple[ColourImage, ColourImage]] = WeakKeyDictionary()


@lru_cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return the font of all text, loaded once per size."""
    return ImageFont.load_default(size)


def slice_panel(view: View, max_size: Size) -> Image.Image:
    """Draw a slice, high z up: each cluster outlined, numbered, and filled with a shade of its tissue's colour.

    Pixels of a landmark that belong to no cluster are darker.

    Args:
        view: Slice to draw, with its clusters.
        max_size: Size (width, height) in pixels that the picture fits into; its aspect ratio is kept.
    """
    # Cluster number of each pixel, 0 if it has none; no pixel is of two tissues.
    numbers = np.sum([tissue.image for tissue in view.clusters.each()], axis=0)
    (n_across, n_depth), (across_mm, depth_mm) = view.geometry.shape, view.geometry.pixel_mm
    size_mm = n_across * across_mm, n_depth * depth_mm
    size = _size(size_mm, _scale(size_mm, max_size))
    # Rows of the picture run from high z, the palm in phantoms, to low z.
    colours = _resized(_slice_colours(view, numbers).transpose(1, 0, 2)[::-1], size)
    codes = np.where(numbers > 0, view.slice_xz * np.int32(numbers.max() + 1) + numbers, 0)
    colours[_outlines(_resized(codes.T[::-1], size))] = OUTLINE_COLOUR
    picture = Image.fromarray(colours)
    draw = ImageDraw.Draw(picture)
    scale = np.divide(size, (n_across, n_depth))
    for tissue in view.clusters.each():
        for number, ((across, depth), n_pixels) in enumerate(zip(tissue.centres, tissue.sizes, strict=True), 1):
            if n_pixels * scale.prod() >= MIN_NUMBERED:
                middle = (across + 0.5) * scale[0], (n_depth - depth - 0.5) * scale[1]
                draw.text(middle, str(number), fill=NUMBER_COLOUR, font=font(13), anchor="mm")
    return picture


def _slice_colours(view: View, numbers: NDArray[np.int32]) -> ColourImage:
    """Return the colours of a slice, shape (across, depth, 3)."""
    colours = TISSUE_COLOURS[view.slice_xz]
    shades = np.where(numbers > 0, np.array(SHADES)[(numbers - 1) % len(SHADES)], UNCLUSTERED)
    is_landmark = np.isin(view.slice_xz, LANDMARK_LABELS)
    colours[is_landmark] = (colours[is_landmark] * shades[is_landmark, None]).astype(np.uint8)
    return colours


def _outlines(codes: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return the outlines of clusters: pixels with a nonzero code next to a pixel with another code."""
    framed = np.pad(codes, 1)
    middle = framed[1:-1, 1:-1]
    beside = (framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:])
    edges: NDArray[np.bool_] = (middle > 0) & np.any([middle != other for other in beside], axis=0)
    return edges


def is_right_handed(volume: LabelVolume) -> bool:
    """Return whether the axes of a volume are right-handed in the world, so that its slices are seen from low Y."""
    return bool(np.linalg.det(volume.direction) > 0)


def side_panels(
    volume: LabelVolume,
    transform: RigidTransform | None,
    planes: Sequence[tuple[ManipulatorAction, Colour, int]],
    max_sizes: tuple[Size, Size],
) -> tuple[Image.Image, Image.Image]:
    """Draw the unmoved volume from high z (frontal) and from the side (sagittal), fingers up, at one scale.

    In a right-handed frame, X then runs to the left, and the side is the one at high x.

    Args:
        volume: Volume to draw.
        transform: Motion of the volume in the episode; None: no motion.
        planes: Planes to outline, in the frame of the moved volume, each with its colour and its line width in pixels;
            the last one is on top.
        max_sizes: Size (width, height) in pixels that each picture fits into; its aspect ratio is kept.
    """
    is_flipped = is_right_handed(volume)
    if volume not in _SIDES:
        labels = volume.labels[::-1] if is_flipped else volume.labels
        from_high_z, from_side = _first_seen(labels[:, :, ::-1], 2), _first_seen(labels, 0)
        _SIDES[volume] = TISSUE_COLOURS[from_high_z.T], TISSUE_COLOURS[from_side]
    across_mm, along_mm, depth_mm = volume.size_mm
    sizes_mm = (across_mm, along_mm), (depth_mm, along_mm)
    scale = min(_scale(size_mm, max_size) for size_mm, max_size in zip(sizes_mm, max_sizes, strict=True))
    frontal, sagittal = (
        Image.fromarray(_resized(colours, _size(size_mm, scale)))
        for colours, size_mm in zip(_SIDES[volume], sizes_mm, strict=True)
    )
    for action, colour, line_width in planes:
        corners_mm = _corners_mm(volume, transform, action)
        if is_flipped:
            corners_mm[:, 0] = across_mm - corners_mm[:, 0]
        for picture, axes in ((frontal, [0, 1]), (sagittal, [2, 1])):
            corners = corners_mm[:, axes] * picture.size / np.array(volume.size_mm)[axes]
            outline = [(x, y) for x, y in (*corners, corners[0])]
            ImageDraw.Draw(picture).line(outline, fill=colour, width=line_width)
    return frontal, sagittal


def _first_seen(labels_xyz: NDArray[np.uint8], axis: int) -> NDArray[np.uint8]:
    """Return the first label along an axis that is not background, 0 if there is none."""
    first = np.expand_dims((labels_xyz > 0).argmax(axis=axis), axis)
    return np.take_along_axis(labels_xyz, first, axis).squeeze(axis)


def _corners_mm(volume: LabelVolume, transform: RigidTransform | None, action: ManipulatorAction) -> FloatArray:
    """Return the four corners of a slice in the unmoved volume, in mm, shape (4, 3)."""
    matrix, offset_mm = (transform or RigidTransform()).plane_map(action)
    across_mm, _, depth_mm = volume.size_mm
    corners = np.array([[0, 0, 0], [across_mm, 0, 0], [across_mm, 0, depth_mm], [0, 0, depth_mm]])
    return corners @ matrix.T + offset_mm


def reward_panel(rewards: Sequence[float], places: range, threshold: float, size: Size) -> Image.Image:
    """Draw rewards from left to right between 0, at the top, and -1.

    Args:
        rewards: Rewards, each in [-1, 0], one or more; they begin at the first of `places`.
        places: Numbers along the horizontal axis.
        threshold: Reward to draw as a line across.
        size: Size (width, height) in pixels.
    """
    width, height = size
    left, top, right, bottom = 36, 8, width - 8, height - 22
    picture = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(picture)

    def y_of(reward: float) -> float:
        return top - reward * (bottom - top)

    for reward in (0.0, -0.5, -1.0):
        draw.line([(left, y_of(reward)), (right, y_of(reward))], fill=LINE_COLOUR)
        draw.text((left - 6, y_of(reward)), f"{reward:g}", fill=FAINT_COLOUR, font=font(12), anchor="rm")
    draw.line([(left, y_of(threshold)), (right, y_of(threshold))], fill=TEXT_COLOUR)
    for end, place, anchor in ((left, places[0], "la"), (right, places[-1], "ra")):
        draw.text((end, bottom + 8), str(place), fill=FAINT_COLOUR, font=font(12), anchor=anchor)
    step = (right - left) / max(1, len(places) - 1)
    points = [(left + place * step, y_of(reward)) for place, reward in enumerate(rewards)]
    draw.line(points, fill=REWARD_COLOUR, width=2)
    x, y = points[-1]
    draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=REWARD_COLOUR)
    return picture


def _scale(size_mm: tuple[float, float], max_size: Size) -> float:
    """Return the pixels per mm of the largest picture that fits into `max_size`."""
    return min(max_size[0] / size_mm[0], max_size[1] / size_mm[1])


def _size(size_mm: tuple[float, float], scale: float) -> Size:
    return max(1, round(size_mm[0] * scale)), max(1, round(size_mm[1] * scale))


def _resized(pixels: NDArray[Pixel], size: Size) -> NDArray[Pixel]:
    """Return pixels resized to a picture of (width, height) by nearest neighbour, shape (rows, columns, ...)."""
    rows, columns = ((np.arange(n) * 2 + 1) * m // (2 * n) for n, m in zip(size[::-1], pixels.shape[:2], strict=True))
    resized: NDArray[Pixel] = pixels[rows[:, None], columns]
    return resized

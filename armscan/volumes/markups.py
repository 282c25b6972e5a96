"""Read and write planes as markups files of 3D Slicer (`.mrk.json`), in world coordinates.

World coordinates are millimetres in LPS (X to the left, Y to the back, Z to the head), the frame of a volume's `origin`
and `direction`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import InvalidValueError, MarkupError
from armscan.utils.arrays import FloatArray
from armscan.utils.files import atomic_write
from armscan.utils.validation import check_path
from armscan.volumes.plane import ManipulatorAction, shift_into
from armscan.volumes.slicer_plane import read_slicer_plane
from armscan.volumes.volume import LabelVolume

MARKUP_SUFFIX = ".mrk.json"
# As Slicer itself writes it.
SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
# Name of the plane in Slicer.
NAME = "optimal plane"
# In mm of depth per mm: a flatter plane meets the volume's floor, where every plane begins, too far away.
MIN_SLOPE = 1e-3
# A rectangle counts as a slice of the volume if their sizes agree to this.
SAME_SIZE_MM = 0.01
ROUNDING_MM = 1e-3


def write_markup(path: str | Path, volume: LabelVolume, action: ManipulatorAction) -> None:
    """Write a plane as the rectangle that its slice covers where Slicer shows the volume.

    The rectangle's x axis runs across and its y axis in depth; the normal completes a right-handed frame.

    Args:
        path: File to write, ending in `.mrk.json`, in an existing folder.
        volume: Volume that the plane belongs to.
        action: Plane in the volume's frame.

    Raises:
        InvalidValueError: If an argument has the wrong type.
        MarkupError: If the file cannot be written.
    """
    path = check_path("the markups file", path)
    if not isinstance(volume, LabelVolume) or not isinstance(action, ManipulatorAction):
        raise InvalidValueError(
            f"volume and action are {volume!r} and {action!r}, but they must be a LabelVolume and a ManipulatorAction"
        )
    if not path.name.endswith(MARKUP_SUFFIX):
        raise MarkupError(f"{path}: a markups file must end in {MARKUP_SUFFIX}, or Slicer does not recognise it")
    document = {"@schema": SCHEMA, "markups": [_markup(volume, action)]}
    try:
        atomic_write(path, json.dumps(document, indent=2) + "\n")
    except OSError as error:
        raise MarkupError(f"{path}: the markups file cannot be written ({error.strerror or error})") from error


def read_markup(path: str | Path, volume: LabelVolume) -> ManipulatorAction:
    """Read the plane of a markups file, written by `write_markup` or drawn in Slicer, in LPS or RAS.

    The result is the same plane as a set of points. A rectangle of a slice's size keeps its position across; otherwise
    the slice is centred on the volume across. A rectangle's rotation within its plane and its position in depth are
    dropped: an action has no such components.

    Args:
        path: File with one plane; it may hold other markups.
        volume: Volume that the plane belongs to.

    Returns:
        The plane in the volume's frame, rz and rx within +-90 degrees, its origin (tx, ty) within the volume.

    Raises:
        InvalidValueError: If an argument has the wrong type.
        MarkupError: If the file does not define a plane, or no action describes it.
    """
    path = check_path("the markups file", path)
    if not isinstance(volume, LabelVolume):
        raise InvalidValueError(f"volume is {volume!r}, but it must be a LabelVolume")
    plane = read_slicer_plane(path)
    origin_mm, axes = np.asarray(volume.origin), volume.direction
    point_mm, normal = np.linalg.solve(axes, plane.point_mm - origin_mm), axes.T @ plane.normal
    # Of the plane's two normals, the one that points along the arm, so that the slice is not mirrored.
    normal *= -1.0 if normal[1] < 0 else 1.0
    rx = np.arctan2(normal[2], np.hypot(normal[0], normal[1]))
    rz = np.arctan2(-normal[0], normal[1])
    turned = ManipulatorAction((float(np.rad2deg(rz)), float(np.rad2deg(rx))), (0.0, 0.0))
    across, in_depth = turned.matrix[:, 0], turned.matrix[:, 2]
    where = f"{path}: the plane given by center and normal, or by controlPoints and baseToNode, lies"
    if in_depth[2] < MIN_SLOPE:
        raise MarkupError(f"{where} along the palm of {volume.name}, but it must cross the arm")
    slice_origin_mm = point_mm - turned.matrix @ _slice_centre(volume)
    # Only a rectangle of a slice's size fixes the position across.
    size_mm = (volume.size_mm[0], volume.size_mm[2])
    if plane.size_mm is None or not np.allclose(plane.size_mm, size_mm, rtol=0.0, atol=SAME_SIZE_MM):
        slice_origin_mm += across @ (np.array(volume.centre_mm) - point_mm) * across
    slice_origin_mm -= slice_origin_mm[2] / in_depth[2] * in_depth
    # Move an origin back that rounding in the file has moved out of the volume.
    within_mm = np.clip(slice_origin_mm[:2], 0.0, volume.size_mm[:2])
    tx, ty = np.where(np.abs(within_mm - slice_origin_mm[:2]) < ROUNDING_MM, within_mm, slice_origin_mm[:2])
    action = ManipulatorAction(turned.rotation, (float(tx), float(ty)))
    slid = shift_into(action, volume.size_mm[:2])
    if slid is None:
        raise MarkupError(
            f"{where} in {volume.name} at {action}, but its origin (tx, ty) must lie within (0, 0) and "
            f"{volume.size_mm[:2]} mm"
        )
    return slid


def _markup(volume: LabelVolume, action: ManipulatorAction) -> dict[str, Any]:
    origin_mm, axes = np.asarray(volume.origin), volume.direction
    across_mm, _, depth_mm = volume.size_mm
    centre = origin_mm + axes @ (action.matrix @ _slice_centre(volume) + action.offset_mm)
    x_axis, y_axis = axes @ action.matrix[:, 0], axes @ action.matrix[:, 2]
    orientation = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    base_to_node = np.eye(4)
    base_to_node[:3, :3], base_to_node[:3, 3] = orientation, centre
    # No objectToBase: without it Slicer uses the identity (which it writes as diag(-1, -1, 1, 1) in LPS).
    return {
        "type": "Plane",
        "name": NAME,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": False,
        "planeType": "pointNormal",
        "sizeMode": "absolute",
        "center": centre.tolist(),
        "normal": orientation[:, 2].tolist(),
        "baseToNode": base_to_node.ravel().tolist(),
        "orientation": orientation.ravel().tolist(),
        "size": [across_mm, depth_mm, 0.0],
        "planeBounds": [-across_mm / 2, across_mm / 2, -depth_mm / 2, depth_mm / 2],
        "controlPoints": [{"id": "1", "label": NAME, "position": centre.tolist(), "positionStatus": "defined"}],
        # With handles, so that it can be corrected at once.
        "display": {"visibility": True, "opacity": 1.0, "handlesInteractive": True},
    }


def _slice_centre(volume: LabelVolume) -> FloatArray:
    """Return the centre of a slice in the plane's frame, which is also the centre of its rectangle of pixels."""
    return np.array([volume.centre_mm[0], 0.0, volume.centre_mm[2]])

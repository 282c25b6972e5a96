"""Planes in markups files of 3D Slicer, read as Slicer reads them.

Slicer derives the plane that it shows from `controlPoints`, by the rule of `planeType`, and for `pointNormal` from the
axes in `baseToNode`, too. It writes `center` and `normal` only for other readers. Source: its schema,
markups-schema-v1.0.3.json, and its classes vtkMRMLMarkupsPlaneNode and vtkMRMLMarkupsPlaneJsonStorageNode.
"""

from __future__ import annotations

import json
import reprlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import InvalidValueError, MarkupError, listed
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_numbers

# From the file's coordinates to LPS.
TO_LPS = {"LPS": np.array([1.0, 1.0, 1.0]), "RAS": np.array([-1.0, -1.0, 1.0])}
# Spellings in Slicer, its schema and other programs, in lower case.
PLANE_TYPES = {
    "pointnormal": "pointNormal",
    "threepoints": "threePoints",
    "3points": "threePoints",
    "planefit": "planeFit",
}
MAX_MM = 1e6
# Two descriptions of one plane may differ by this much, because the file rounds.
SAME_MM, SAME_DEG = 0.1, 0.1

Plane = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class SlicerPlane:
    """A plane in the world, in LPS.

    Args:
        point_mm: Point of the plane, in mm, shape (3,): the rectangle's centre if the file has a point and a normal.
        normal: Unit normal, of either sign, shape (3,).
        size_mm: Width and height of the rectangle in mm; None if the file has no size.
    """

    point_mm: FloatArray
    normal: FloatArray
    size_mm: tuple[float, float] | None


def read_slicer_plane(path: Path) -> SlicerPlane:
    """Read the one plane of a markups file.

    Raises:
        MarkupError: If the file cannot be read, holds no plane or several, is in units other than mm, does not define
            where the plane lies, or defines it in two ways that disagree.
    """
    markup = _only_plane(_load(path), path)
    system, units = markup.get("coordinateSystem", "LPS"), markup.get("coordinateUnits", "mm")
    if not isinstance(system, str) or system not in TO_LPS:
        raise _error(path, "coordinateSystem", system, listed(TO_LPS))
    # Either the unit, or a list of its code, coding scheme and name.
    if (units[0] if isinstance(units, list) and units else units) != "mm":
        raise _error(path, "coordinateUnits", units, "mm")
    point_mm, normal = _agreed(_shown(markup, path), _stated(markup, path), path)
    size = _numbers(markup, "size", 3, path) if "size" in markup else None
    return SlicerPlane(
        point_mm=TO_LPS[system] * point_mm,
        normal=TO_LPS[system] * normal,
        size_mm=None if size is None else (float(size[0]), float(size[1])),
    )


def _load(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise MarkupError(f"{path}: the markups file cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        raise MarkupError(f"{path}: the markups file cannot be read as JSON ({error})") from error


def _only_plane(document: Any, path: Path) -> dict[str, Any]:
    markups = document.get("markups") if isinstance(document, dict) else None
    if not isinstance(markups, list) or not all(isinstance(markup, dict) for markup in markups):
        raise _error(path, "markups", markups, "a list of objects")
    planes: list[dict[str, Any]] = [markup for markup in markups if markup.get("type") == "Plane"]
    if len(planes) != 1:
        types = [markup.get("type") for markup in markups]
        raise _error(path, "the type of the markups", types, "'Plane' for exactly one of them")
    return planes[0]


def _shown(markup: dict[str, Any], path: Path) -> Plane | None:
    """Return the plane that Slicer shows; None if the file lacks the entries for it."""
    # Files without a type predate the other types.
    kind = markup.get("planeType", "threePoints")
    if not isinstance(kind, str) or kind.lower() not in PLANE_TYPES:
        raise _error(path, "planeType", kind, listed(sorted(set(PLANE_TYPES.values()))))
    kind = PLANE_TYPES[kind.lower()]
    points = _control_points(markup, path)
    if kind == "pointNormal" and len(points) > 1:
        return points[0], _unit(points[1] - points[0], "controlPoints", path)
    if kind == "pointNormal" and len(points) == 1 and "baseToNode" in markup:
        # Columns: the plane's x axis, y axis and normal, and a position, which Slicer replaces by the control point.
        base_to_node = _numbers(markup, "baseToNode", 16, path).reshape(4, 4)
        return points[0], _unit(base_to_node[:3, 2], "baseToNode", path)
    if kind != "pointNormal" and len(points) >= 3:
        return _fitted(points[:3] if kind == "threePoints" else points, path)
    return None


def _stated(markup: dict[str, Any], path: Path) -> Plane | None:
    """Return the plane given by `center` and `normal`; None if the file lacks either."""
    if "center" not in markup or "normal" not in markup:
        return None
    return _numbers(markup, "center", 3, path), _unit(_numbers(markup, "normal", 3, path), "normal", path)


def _agreed(shown: Plane | None, stated: Plane | None, path: Path) -> Plane:
    if shown is None or stated is None:
        only = shown or stated
        if only is None:
            raise MarkupError(
                f"{path}: has too few controlPoints for its planeType, or no baseToNode, and no center and normal"
            )
        return only
    offset_mm = abs(float(shown[1] @ (stated[0] - shown[0])))
    sine = float(np.linalg.norm(np.cross(shown[1], stated[1])))
    angle_deg = float(np.rad2deg(np.arcsin(min(1.0, sine))))
    if offset_mm > SAME_MM or angle_deg > SAME_DEG:
        raise MarkupError(
            f"{path}: center and normal are {offset_mm:.2f} mm and {angle_deg:.2f} degrees off the plane that Slicer "
            "shows by controlPoints and baseToNode, but they must be the same plane; take center and normal out"
        )
    return shown


def _control_points(markup: dict[str, Any], path: Path) -> FloatArray:
    """Return the positions of the control points that have been placed, shape (n, 3)."""
    points = markup.get("controlPoints", [])
    if not isinstance(points, list) or not all(isinstance(point, dict) for point in points):
        raise _error(path, "controlPoints", points, "a list of objects")
    placed = [point for point in points if point.get("positionStatus", "defined") == "defined"]
    return np.array([_numbers(point, "position", 3, path) for point in placed]).reshape(-1, 3)


def _fitted(points: FloatArray, path: Path) -> Plane:
    """Return the least-squares plane through points, shape (n, 3)."""
    middle = points.mean(axis=0)
    _, extents, directions = np.linalg.svd(points - middle)
    if extents[1] < 1e-6 * max(1.0, extents[0]):
        raise _error(path, "controlPoints", points.tolist(), "points that do not lie on one line")
    return middle, directions[2]


def _numbers(markup: dict[str, Any], key: str, length: int, path: Path) -> FloatArray:
    try:
        numbers = np.array(check_numbers(key, markup.get(key), length, ""))
    except InvalidValueError as error:
        raise _error(path, key, markup.get(key), f"{length} finite numbers") from error
    if np.abs(numbers).max() > MAX_MM:
        raise _error(path, key, markup.get(key), f"{length} numbers within +-{MAX_MM:g}")
    return numbers


def _unit(direction: FloatArray, key: str, path: Path) -> FloatArray:
    length = float(np.linalg.norm(direction))
    if length < 1e-6:
        raise _error(path, key, direction.tolist(), "a direction other than zero")
    unit: FloatArray = direction / length
    return unit


def _error(path: Path, key: str, value: Any, allowed: str) -> MarkupError:
    return MarkupError(f"{path}: {key} is {reprlib.repr(value)}, but it must be {allowed}")

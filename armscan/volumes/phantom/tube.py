"""The one shape that phantoms are made of: an elliptical tube along the arm, and its compiled rasterisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from armscan.utils.arrays import FloatArray
from armscan.utils.compilation import cached_njit

Y, X, Z, RADIUS_X, RADIUS_Z = range(5)


@dataclass(frozen=True, eq=False)
class Tube:
    """A stack of ellipses in the wrist's own frame, interpolated linearly between its nodes.

    Args:
        label: Label of its voxels.
        nodes: Nodes of the centre line, shape (n, 5), each (y, x, z, radius_x, radius_z) in mm, ordered by y.
    """

    label: int
    nodes: FloatArray

    @classmethod
    def ovoid(cls, label: int, centre: tuple[float, float, float], radii: tuple[float, float, float]) -> Self:
        """Return an ovoid with blunt ends, `centre` and `radii` (x, y, z) in mm."""
        x, y, z = centre
        heights = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 17))
        width = (1 - np.abs(heights) ** 3.0) ** 0.5
        columns = (y + radii[1] * heights, x, z, radii[0] * width, radii[2] * width)
        return cls(label, np.stack(np.broadcast_arrays(*columns), axis=1))

    @classmethod
    def shaft(
        cls, label: int, ends: tuple[tuple[float, float, float], tuple[float, float, float]], radii: tuple[float, float]
    ) -> Self:
        """Return a long bone between two ends (x, y, z), thinner in the middle; `radii` (end, middle) in mm."""
        start, stop = sorted(ends, key=lambda end: end[1])
        along = np.array([0.0, 0.02, 0.06, 0.15, 0.3, 0.5, 0.7, 0.85, 0.94, 0.98, 1.0])
        end, middle = radii
        profile = middle + (end - middle) * np.abs(2 * along - 1) ** 2
        profile *= np.clip(np.minimum(along, 1 - along) / 0.06, 0.0, 1.0) ** 0.5
        x, y, z = (start[axis] + (stop[axis] - start[axis]) * along for axis in range(3))
        return cls(label, np.stack([y, x, z, profile, profile], axis=1))

    @classmethod
    def cord(cls, label: int, nodes: list[tuple[float, float, float, float, float]]) -> Self:
        """Return a tendon, vessel or nerve through nodes (y, x, z, radius_x, radius_z), in any order along y."""
        return cls(label, np.array(sorted(nodes)))

    def arrange(
        self,
        *,
        shift_mm: Sequence[float] | FloatArray = (0.0, 0.0, 0.0),
        stretch: Sequence[float] = (1.0, 1.0, 1.0),
        thickness: Sequence[float] | FloatArray = (1.0, 1.0),
    ) -> Tube:
        """Return the tube with positions times `stretch` (x, y, z), then shifted, and radii times `thickness`."""
        nodes = self.nodes.copy()
        nodes[:, [X, Y, Z]] = nodes[:, [X, Y, Z]] * stretch + shift_mm
        nodes[:, [RADIUS_X, RADIUS_Z]] *= thickness
        return Tube(self.label, nodes)

    def between(self, low_mm: float, high_mm: float) -> Tube:
        """Return the part of the tube from `low_mm` to `high_mm` along the arm."""
        y = self.nodes[:, Y]
        ends = np.clip([low_mm, high_mm], y[0], y[-1])
        places = np.concatenate([ends[:1], y[(y > ends[0]) & (y < ends[1])], ends[1:]])
        return Tube(self.label, np.stack([np.interp(places, y, column) for column in self.nodes.T], axis=1))

    def mirror(self) -> Tube:
        """Return the same tube of the other hand."""
        nodes = self.nodes.copy()
        nodes[:, X] *= -1
        return Tube(self.label, nodes)

    def scale(self, factor: float) -> Tube:
        """Return the same tube of a larger or smaller hand."""
        return Tube(self.label, self.nodes * factor)


@cached_njit()
def fill_tube(
    labels_xyz: NDArray[np.uint8],
    spacing_mm: tuple[float, float, float],
    matrix: FloatArray,
    origin_mm: FloatArray,
    nodes: FloatArray,
    label: int,
) -> None:
    """Label the background voxels of a volume that lie in a tube.

    Args:
        labels_xyz: Labels of the volume, changed in place; only voxels with 0 are labelled.
        spacing_mm: Voxel spacing (sx, sy, sz) in mm.
        matrix: Rotation from the wrist's frame into the volume's, shape (3, 3).
        origin_mm: Position of the wrist's origin in the volume, in mm, shape (3,).
        nodes: Nodes of the centre line, shape (n, 5); see `Tube`.
        label: Label to write.
    """
    corner = np.empty(3)
    for segment in range(nodes.shape[0] - 1):
        y_low, y_high = nodes[segment, 0], nodes[segment + 1, 0]
        if y_high <= y_low:
            continue
        # The bounding box of the segment's two ellipses, in voxels.
        low = np.full(3, np.inf)
        high = np.full(3, -np.inf)
        for end in range(segment, segment + 2):
            for side_x in (-1.0, 1.0):
                for side_z in (-1.0, 1.0):
                    corner[0] = nodes[end, 1] + side_x * nodes[end, 3]
                    corner[1] = nodes[end, 0]
                    corner[2] = nodes[end, 2] + side_z * nodes[end, 4]
                    for axis in range(3):
                        position = origin_mm[axis]
                        for column in range(3):
                            position += matrix[axis, column] * corner[column]
                        low[axis] = min(low[axis], position)
                        high[axis] = max(high[axis], position)
        first = np.empty(3, dtype=np.int64)
        last = np.empty(3, dtype=np.int64)
        for axis in range(3):
            first[axis] = max(0, int(np.floor(low[axis] / spacing_mm[axis])))
            last[axis] = min(labels_xyz.shape[axis] - 1, int(np.ceil(high[axis] / spacing_mm[axis])))
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                for k in range(first[2], last[2] + 1):
                    d_x = i * spacing_mm[0] - origin_mm[0]
                    d_y = j * spacing_mm[1] - origin_mm[1]
                    d_z = k * spacing_mm[2] - origin_mm[2]
                    y = matrix[0, 1] * d_x + matrix[1, 1] * d_y + matrix[2, 1] * d_z
                    if y < y_low or y >= y_high or labels_xyz[i, j, k] != 0:
                        continue
                    t = (y - y_low) / (y_high - y_low)
                    radius_x = nodes[segment, 3] + t * (nodes[segment + 1, 3] - nodes[segment, 3])
                    radius_z = nodes[segment, 4] + t * (nodes[segment + 1, 4] - nodes[segment, 4])
                    if radius_x <= 0.0 or radius_z <= 0.0:
                        continue
                    x = matrix[0, 0] * d_x + matrix[1, 0] * d_y + matrix[2, 0] * d_z
                    z = matrix[0, 2] * d_x + matrix[1, 2] * d_y + matrix[2, 2] * d_z
                    x -= nodes[segment, 1] + t * (nodes[segment + 1, 1] - nodes[segment, 1])
                    z -= nodes[segment, 2] + t * (nodes[segment + 1, 2] - nodes[segment, 2])
                    if (x / radius_x) ** 2 + (z / radius_z) ** 2 <= 1.0:
                        labels_xyz[i, j, k] = label

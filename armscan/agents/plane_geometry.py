"""Planes, and where one lies in the frame of another, for batches of tensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from armscan.envs.actions import ActionBounds
from armscan.envs.rules import ON_BUDGET, ON_STOP, Rules
from armscan.errors import InvalidValueError, listed

# Limits of a plane in the frame of another: sine of its tilt, and position across in mm.
MAX_TILT, MAX_ACROSS_MM = 0.98, 60.0
TINY = 1e-6


class PlaneGeometry(nn.Module):
    """Planes (rz, rx, tx, ty) in degrees and mm, whose slices share one middle and one set of bounds.

    In the frame of a reference plane (across, along its normal, in depth), a plane is four numbers: the two components
    of its normal that lie in the reference plane; its distance from the middle of the reference slice, along its own
    normal, in mm; and the position across of its own slice's middle, in mm.

    Args:
        bounds: Ranges of the components, in degrees and mm.
        middle_mm: Middle of every slice, (across, depth) in mm from the plane's origin.
    """

    bounds: Tensor
    middle: Tensor

    def __init__(self, bounds: ActionBounds, middle_mm: Sequence[float]) -> None:
        super().__init__()
        self.register_buffer("bounds", torch.tensor([*bounds.rotation_deg, *bounds.translation_mm]))
        self.register_buffer("middle", torch.tensor([middle_mm[0], 0.0, middle_mm[1]]))

    def planes(self, actions: Tensor) -> Tensor:
        """Return the planes of normalised actions, both shape (..., 4)."""
        return torch.cat([actions[..., :2], (actions[..., 2:] + 1.0) / 2.0], dim=-1) * self.bounds

    def actions(self, planes: Tensor) -> Tensor:
        """Return the normalised actions of planes, both shape (..., 4)."""
        shares = planes / self.bounds.clamp(min=TINY)
        return torch.cat([shares[..., :2], shares[..., 2:] * 2.0 - 1.0], dim=-1).clamp(-1.0, 1.0)

    def normals(self, planes: Tensor) -> Tensor:
        """Return the normals of planes, shape (n, 3)."""
        return _matrices(planes)[:, :, 1]

    def middles(self, planes: Tensor) -> Tensor:
        """Return the middles of the slices of planes, shape (n, 3), in mm."""
        return _matrices(planes) @ self.middle + _origins(planes)

    def seen_from(self, planes: Tensor, others: Tensor) -> Tensor:
        """Return where `others` lie in the frames of `planes`, shape (n, 4)."""
        # Each matrix is computed once: torch's small operations take most of a decision's time.
        matrices, matrices_of_others, origins = _matrices(planes), _matrices(others), _origins(planes)
        normals, middles = matrices_of_others[:, :, 1], matrices_of_others @ self.middle + _origins(others)
        local = _turned_back(matrices, normals)
        sign = torch.where(local[:, 1:2] < 0.0, -1.0, 1.0)
        local = local * sign
        distance_mm = ((middles - (matrices @ self.middle + origins)) * normals).sum(1, keepdim=True) * sign
        across_mm = _turned_back(matrices, middles - origins)[:, :1] - self.middle[0]
        return torch.cat([local[:, :1], local[:, 2:], distance_mm, across_mm], dim=1)

    def from_frame(self, planes: Tensor, seen: Tensor, beside_mm: Tensor) -> Tensor:
        """Return the planes that lie at `seen` in the frames of `planes`, moved along their normals; shape (n, 4).

        Args:
            planes: Reference planes, shape (n, 4).
            seen: Planes in the frames of the reference planes, shape (n, 4); see `seen_from`.
            beside_mm: Offset along the normals, in mm, shape (n,).
        """
        tilt = seen[:, :2]
        tilt = tilt * (MAX_TILT / tilt.norm(dim=1, keepdim=True).clamp(min=MAX_TILT))
        upright = (1.0 - (tilt**2).sum(1, keepdim=True)).clamp(min=TINY).sqrt()
        local = torch.cat([tilt[:, :1], upright, tilt[:, 1:]], dim=1)
        # Start at the nearest point of the plane, and move along the projection of the across axis onto it.
        step = torch.eye(3, dtype=seen.dtype, device=seen.device)[0] - local * local[:, :1]
        distance_mm = seen[:, 2:3] + beside_mm[:, None]
        across_mm = seen[:, 3:4].clamp(-MAX_ACROSS_MM, MAX_ACROSS_MM) - distance_mm * local[:, :1]
        points = self.middle + distance_mm * local + step * (across_mm / step[:, :1].clamp(min=1.0 - MAX_TILT**2))
        matrices = _matrices(planes)
        return self.through(_turned(matrices, local), _turned(matrices, points) + _origins(planes))

    def through(self, normals: Tensor, points: Tensor) -> Tensor:
        """Return planes with these normals, their slices centred across on these points, shape (n, 4).

        Rotations are clipped to the bounds; origins slide along the plane into them.
        """
        upright = normals * torch.where(normals[:, 1:2] < 0.0, -1.0, 1.0)
        rz = torch.rad2deg(torch.atan(-upright[:, 0] / upright[:, 1].clamp(min=TINY)))
        rx = torch.rad2deg(torch.asin(upright[:, 2].clamp(-1.0, 1.0)))
        rotations = torch.minimum(torch.maximum(torch.stack([rz, rx], 1), -self.bounds[:2]), self.bounds[:2])
        matrices = _matrices(torch.cat([rotations, torch.zeros_like(rotations)], dim=1))
        across, normal = matrices[:, :2, 0], matrices[:, :, 1]
        # The origin (tx, ty, 0) lies in the plane, `middle[0]` across from the point.
        height = (normal * points).sum(1)
        place = (across * points[:, :2]).sum(1) - self.middle[0]
        determinant = across[:, 0] * normal[:, 1] - across[:, 1] * normal[:, 0]
        tx = (place * normal[:, 1] - across[:, 1] * height) / determinant
        ty = (across[:, 0] * height - normal[:, 0] * place) / determinant
        return torch.cat([rotations, self._slid(torch.stack([tx, ty], 1), across)], dim=1)

    def _slid(self, origins: Tensor, across: Tensor) -> Tensor:
        """Slide origins along their planes into the bounds, as little as possible, as `shift_into` does."""
        step = torch.where(across.abs() < TINY, TINY, across)
        ends = torch.stack([-origins / step, (self.bounds[2:] - origins) / step])
        lowest, highest = ends.amin(0).amax(1), ends.amax(0).amin(1)
        distance_mm = torch.minimum(lowest.clamp(min=0.0), torch.maximum(highest, lowest))
        slid = origins + distance_mm[:, None] * across
        return torch.minimum(slid.clamp(min=0.0), self.bounds[2:])

    def errors(self, planes: Tensor, optima: Tensor) -> Tensor:
        """Return how far planes are from the labelled ones, in mm and degrees, shape (n, 2); see `plane_distance`."""
        normals = self.normals(optima)
        distance_mm = ((self.middles(planes) - self.middles(optima)) * normals).sum(1).abs()
        cross = torch.linalg.cross(self.normals(planes), normals).norm(dim=1)
        return torch.stack([distance_mm, torch.rad2deg(torch.asin(cross.clamp(max=1.0)))], dim=1)


def common_geometry(rules: Rules, n_looks: int) -> PlaneGeometry:
    """Return one geometry for all volumes of environments in which an agent takes `n_looks` looks.

    Observations are centred on their slice's middle, so the mean middle serves slices of all sizes.

    Raises:
        InvalidValueError: If the bounds differ between volumes, or an episode may end before or after the last look.
    """
    fits = {ON_BUDGET: rules.max_steps == n_looks, ON_STOP: rules.max_steps >= n_looks}
    if not fits.get(rules.ends):
        raise InvalidValueError(
            f"env.ends is {rules.ends!r} and env.max_steps is {rules.max_steps}, but a plane finder takes {n_looks} "
            f"looks, and the last one is its answer: take env.ends=on_budget and env.max_steps={n_looks}, or "
            f"env.ends=on_stop and at least env.max_steps={n_looks}"
        )
    bounds = set(rules.bounds.values())
    if len(bounds) > 1:
        sizes = listed(" x ".join(f"{mm:g}" for mm in each.translation_mm) for each in bounds)
        raise InvalidValueError(
            f"the bounds of translations are {sizes} mm, but a plane finder needs the same on all volumes: give "
            "env.translation_bounds_mm"
        )
    middles = np.array([volume.slice_centre_mm for volume in rules.volumes.values()])
    return PlaneGeometry(bounds.pop(), middles.mean(axis=0).tolist())


def _matrices(planes: Tensor) -> Tensor:
    """Return Rz(rz) Rx(rx) of planes, shape (n, 3, 3)."""
    rz, rx = torch.deg2rad(planes[:, 0]), torch.deg2rad(planes[:, 1])
    (cos_z, sin_z), (cos_x, sin_x) = (rz.cos(), rz.sin()), (rx.cos(), rx.sin())
    rows = [cos_z, -sin_z * cos_x, sin_z * sin_x, sin_z, cos_z * cos_x, -cos_z * sin_x, torch.zeros_like(rz), sin_x]
    return torch.stack([*rows, cos_x], dim=1).reshape(-1, 3, 3)


def _origins(planes: Tensor) -> Tensor:
    return torch.cat([planes[:, 2:], torch.zeros_like(planes[:, :1])], dim=1)


def _turned(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _turned_back(matrices: Tensor, vectors: Tensor) -> Tensor:
    return _turned(matrices.transpose(1, 2), vectors)

"""Resample volumes to a common spacing."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from armscan.errors import VolumeError
from armscan.volumes.stored_voxels import MAX_VOXELS
from armscan.volumes.volume import LabelVolume

Spacing = tuple[float, float, float]


def finest_spacing(volumes: Iterable[LabelVolume]) -> Spacing:
    """Return the smallest spacing along each axis, in mm."""
    s_x, s_y, s_z = (min(steps) for steps in zip(*(volume.spacing for volume in volumes), strict=True))
    return s_x, s_y, s_z


def is_same_spacing(one: Spacing, other: Spacing) -> bool:
    """Return whether two spacings are the same, as files store them: to about six digits."""
    return np.allclose(one, other, rtol=1e-5, atol=0.0)


def resample(volume: LabelVolume, spacing: Spacing) -> LabelVolume:
    """Resample a volume by nearest neighbour.

    The first voxel's centre stays fixed, and with it the volume's frame and every plane.

    Args:
        volume: Volume to resample; returned unchanged if it already has the spacing.
        spacing: Voxel spacing (sx, sy, sz) in mm, each above 0.

    Returns:
        The volume, with every voxel of that spacing whose centre lies within the original.

    Raises:
        VolumeError: If the volume would have more than 2^30 voxels.
    """
    if is_same_spacing(volume.spacing, spacing):
        return volume
    # Deferred: slow to import, and few folders need it.
    import SimpleITK

    # Infinitely many are too many as well.
    with np.errstate(over="ignore"):
        # A centre on the far edge itself is no longer inside.
        size = np.divide((np.array(volume.shape) - 0.5) * volume.spacing, spacing)
        size = np.maximum(1, np.ceil(size - 1e-6))
        n_voxels = size.prod()
    if not n_voxels <= MAX_VOXELS:
        raise VolumeError(
            f"{volume.name}: resampled from {volume.spacing} to {spacing} mm it would have {n_voxels:.3g} voxels, but "
            f"it must have at most {MAX_VOXELS}"
        )
    # In the volume's own frame: its transform to world coordinates does not change.
    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(volume.labels.transpose(2, 1, 0)))
    image.SetSpacing(volume.spacing)
    unmoved, nearest = SimpleITK.Transform(), SimpleITK.sitkNearestNeighbor
    finer = SimpleITK.Resample(
        image, size.astype(int).tolist(), unmoved, nearest, image.GetOrigin(), spacing, image.GetDirection()
    )
    return replace(volume, labels=SimpleITK.GetArrayFromImage(finer).transpose(2, 1, 0), spacing=spacing)

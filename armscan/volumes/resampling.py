"""Volumes of different spacing, brought to one."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from armscan.errors import InvalidValueError, VolumeError
from armscan.utils.validation import check_numbers
from armscan.volumes.volume import LabelVolume

Spacing = tuple[float, float, float]

# More than any scanner gives; a spacing that asks for more is a mistake.
MAX_VOXELS = 2**30


def finest_spacing(volumes: Iterable[LabelVolume]) -> Spacing:
    """Return the smallest spacing along each axis, in mm."""
    s_x, s_y, s_z = (min(steps) for steps in zip(*(volume.spacing for volume in volumes), strict=True))
    return s_x, s_y, s_z


def resample(volume: LabelVolume, spacing: Spacing) -> LabelVolume:
    """Resample a volume by the nearest neighbour.

    The first voxel's centre stays where it is, so that the volume's frame, and with it every plane, stays the same.

    Args:
        volume: to resample; it is returned as it is where it already has the spacing.
        spacing: (sx, sy, sz) in mm.

    Returns:
        The volume with as many voxels of that spacing as have their centres in it.

    Raises:
        InvalidValueError: if the spacing is not three numbers above 0.
        VolumeError: if the volume would have more than 2^30 voxels.
    """
    s_x, s_y, s_z = check_numbers("spacing", spacing, 3, "(sx, sy, sz) in mm")
    if min(s_x, s_y, s_z) <= 0:
        raise InvalidValueError(f"spacing is {spacing!r}, but each must be above 0 mm")
    spacing = (s_x, s_y, s_z)
    # Files keep spacings with some six digits.
    if np.allclose(volume.spacing, spacing, rtol=1e-5, atol=0.0):
        return volume
    import SimpleITK

    steps = [(n - 0.5) * own / new for n, own, new in zip(volume.shape, volume.spacing, spacing, strict=True)]
    if not math.prod(steps) <= MAX_VOXELS:
        raise VolumeError(
            f"{volume.name}: resampled from {volume.spacing} to {spacing} mm it would have {math.prod(steps):.3g} "
            f"voxels, but it must have at most {MAX_VOXELS}"
        )
    # In the volume's own frame: the way to world coordinates is the same before and after.
    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(volume.labels.transpose(2, 1, 0)))
    image.SetSpacing(volume.spacing)
    # A centre on the far edge itself is no longer inside.
    size = [max(1, math.ceil(step - 1e-6)) for step in steps]
    finer = SimpleITK.Resample(
        image,
        size,
        SimpleITK.Transform(),
        SimpleITK.sitkNearestNeighbor,
        (0.0, 0.0, 0.0),
        spacing,
        image.GetDirection(),
    )
    labels = SimpleITK.GetArrayFromImage(finer).transpose(2, 1, 0)
    return replace(volume, labels=labels, spacing=spacing)

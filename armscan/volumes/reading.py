"""From image files to labelmap volumes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from armscan.checks import check_path
from armscan.errors import VolumeError, listed
from armscan.volumes.headers import CHECKS
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.volume import LabelVolume


def volume_suffix(path: Path) -> str | None:
    """Returns the ending that says a file is a volume ('.nii.gz', ...), None for any other file."""
    return next((suffix for suffix in CHECKS if path.name.endswith(suffix)), None)


def read_volume(
    path: str | Path,
    *,
    name: str | None = None,
    optimal_action: ManipulatorAction | None = None,
    axes: str = "xyz",
) -> LabelVolume:
    """Reads a labelmap from .nii, .nii.gz, .nrrd, .mha or .mhd.

    Args:
        path: the file.
        name: the volume's name; the file's where it is None.
        optimal_action: the labelled plane, in the frame of the volume as returned.
        axes: which of the arm's axes the file's first, second and third axis are; 'xyz' where X runs across the palm,
            Y along the arm and Z through the depth.

    Returns:
        The volume, its array in the order x, y, z.

    Raises:
        VolumeError: naming the file, if it is missing, damaged, truncated, no 3-D scalar image, no labelmap, or has a
            spacing that is not finite and positive.
    """
    # Deferred: it takes long to load, and who steps through phantoms never needs it.
    import SimpleITK

    path = check_path("the volume's file", path)
    suffix = volume_suffix(path)
    if suffix is None:
        raise VolumeError(f"{path}: a volume is read from {listed(CHECKS)}")
    if not isinstance(axes, str) or sorted(axes) != ["x", "y", "z"]:
        raise VolumeError(f"{path}: axes is {axes!r}, but it must be the letters x, y and z in some order")
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        if not path.is_file():
            raise VolumeError(f"{path}: there is no such file")
        CHECKS[suffix](path)
        image = SimpleITK.ReadImage(str(path))
    except OSError as error:
        raise VolumeError(f"{path}: the file cannot be read ({error.strerror or error})") from error
    except RuntimeError as error:
        reason = " ".join(str(error).split("ERROR:")[-1].split())[:200]
        raise VolumeError(f"{path}: the file is truncated or damaged, or no image ({reason})") from error
    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1:
        raise VolumeError(
            f"{path}: the image is {image.GetDimension()}-D with {image.GetNumberOfComponentsPerPixel()} value(s) a "
            "voxel, but a labelmap is 3-D with one"
        )
    # SimpleITK's arrays are indexed [z, y, x]; `order` then brings the file's axes into the arm's.
    order = tuple(axes.index(axis) for axis in "xyz")
    labels = SimpleITK.GetArrayViewFromImage(image).transpose(2, 1, 0).transpose(order)
    spacing = image.GetSpacing()
    return LabelVolume(
        labels,
        (spacing[order[0]], spacing[order[1]], spacing[order[2]]),
        name=name or path.name,
        optimal_action=optimal_action,
        origin=image.GetOrigin(),
        direction=np.array(image.GetDirection()).reshape(3, 3)[:, order],
    )

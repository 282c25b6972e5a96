"""Read image files as labelmap volumes."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from armscan.errors import MAX_REASON_CHARS, InvalidValueError, VolumeError, in_one_line, listed
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_choice, check_path
from armscan.volumes.header_checks import CHECKS
from armscan.volumes.labelmap import FoundSource, LabelMap, check_landmarks, map_values
from armscan.volumes.nifti_header import states_directions
from armscan.volumes.orientation import AXES, Crop, check_axes, check_crop, check_orientation, orientation_of
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.segmentation import OVERLAPS, SEGMENTATION_SUFFIX, read_segmentation
from armscan.volumes.volume import LabelVolume
from armscan.volumes.volume_report import StoredFile, missing_sources

if TYPE_CHECKING:
    import SimpleITK

# A voxel's centre this close to the edge of a crop, in voxels, is inside.
ON_EDGE = 1e-6


@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading a file; see `read_volume`."""

    labels: LabelMap | None = None
    orientation: str | None = None
    axes: str = "xyz"
    crop_mm: Crop | None = None
    overlap: str = "refuse"

    def __post_init__(self) -> None:
        if self.labels is not None and not isinstance(self.labels, LabelMap):
            raise InvalidValueError(f"labels is {self.labels!r}, but it must be a LabelMap or None")
        check_orientation(self.orientation)
        check_axes(self.axes)
        object.__setattr__(self, "crop_mm", check_crop(self.crop_mm))
        check_choice("overlap", self.overlap, OVERLAPS)


def read_volume(
    path: str | Path,
    *,
    name: str | None = None,
    optimal_action: ManipulatorAction | None = None,
    labels: LabelMap | None = None,
    orientation: str | None = None,
    axes: str = "xyz",
    crop_mm: Crop | None = None,
    overlap: str = "refuse",
) -> LabelVolume:
    """Read a labelmap from .nii, .nii.gz, .nrrd, .mha or .mhd, or a segmentation of 3D Slicer from .seg.nrrd.

    Voxels keep the world coordinates of the file, however the array is reoriented and cropped.

    Args:
        path: File to read.
        name: Name of the volume. Default: None, the file's name.
        optimal_action: Labelled plane, in the frame of the volume as returned. Default: None, no plane.
        labels: Mapping from values or segments to tissues. Default: None, values are the labels of `LabelVolume`, and
            segments are named bones, tendons, artery, nerve or background.
        orientation: Orientation to bring the image into first, such as 'LPS'. Default: None, as in the file.
        axes: Axes of the arm that the image's first, second and third axis then run along: X across the palm, Y along
            the arm, Z through the depth. Default: 'xyz'.
        crop_mm: Part of the volume to keep, cropped last: a range in mm from the first voxel's centre, for any of the
            axes x, y and z. Voxels whose centres lie in it are kept; the first of them becomes the frame's origin.
            Default: None, all of it.
        overlap: Rule for voxels in segments of different tissues: `refuse` raises, `first` and `last` take the tissue
            of the first or last segment in the file. Default: `refuse`.

    Returns:
        The volume, its array indexed [x, y, z].

    Raises:
        VolumeError: If the file is missing, damaged, truncated, not a 3-D scalar image, not a labelmap, or has a
            spacing that is not finite and positive; or if an argument is not as above.
    """
    path = check_path("the volume's file", path)
    try:
        options = ReadingOptions(labels, orientation, axes, crop_mm, overlap)
    except InvalidValueError as error:
        raise VolumeError(f"{path}: {error}") from error
    return read_stored(path, options, name=name, optimal_action=optimal_action)[0]


def read_stored(
    path: Path,
    options: ReadingOptions,
    *,
    name: str | None = None,
    optimal_action: ManipulatorAction | None = None,
) -> tuple[LabelVolume, StoredFile]:
    """Read a volume as `read_volume` does; also return details of its file."""
    image, found = _read_labels(path, options)
    if options.labels is not None:
        check_landmarks(found, options.labels, str(path))
    labels, spacing, origin, direction = _in_order(image, options, path)
    volume = LabelVolume(
        labels,
        (spacing[0], spacing[1], spacing[2]),
        name=path.name if name is None else name,
        optimal_action=optimal_action,
        origin=(origin[0], origin[1], origin[2]),
        direction=direction,
    )
    stored = StoredFile(
        shape=image.GetSize(),
        spacing=image.GetSpacing(),
        orientation=orientation_of(np.array(image.GetDirection()).reshape(3, 3)),
        found=found,
        missing=missing_sources(options.labels, found),
        crop_mm=options.crop_mm,
        has_directions=_states_directions(path),
    )
    return volume, stored


def _states_directions(path: Path) -> bool:
    return not path.name.endswith((".nii", ".nii.gz")) or states_directions(path)


def _read_labels(path: Path, options: ReadingOptions) -> tuple[SimpleITK.Image, tuple[FoundSource, ...]]:
    """Return the file as a SimpleITK image of the labels 0 to 4, and the values found in it."""
    # Deferred: slow to import, and phantoms do not need it.
    import SimpleITK

    suffix = next((suffix for suffix in CHECKS if path.name.endswith(suffix)), None)
    if suffix is None:
        raise VolumeError(f"{path}: a volume is read from {listed(CHECKS)}")
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        if not path.is_file():
            raise VolumeError(f"{path}: there is no such file")
        # A file name may hold any bytes; SimpleITK would abort the process on one that is not valid text.
        str(path).encode()
        CHECKS[suffix](path)
        if suffix == SEGMENTATION_SUFFIX:
            labels, matrix, found = read_segmentation(path, options.labels, options.overlap)
            return _image(labels, matrix, path), found
        stored = _read_image(path)
    except UnicodeEncodeError as error:
        raise VolumeError(f"{str(path)!a}: the file's name must be valid UTF-8") from error
    except OSError as error:
        raise VolumeError(f"{path}: the file cannot be read ({error.strerror or error})") from error
    except RuntimeError as error:
        reason = in_one_line(str(error).split("ERROR:")[-1])[:MAX_REASON_CHARS]
        raise VolumeError(f"{path}: the file is truncated or damaged, or no image ({reason})") from error
    if stored.GetDimension() == 4 and stored.GetSize()[3] == 1:
        # A single time point.
        stored = stored[:, :, :, 0]
    if stored.GetDimension() != 3 or stored.GetNumberOfComponentsPerPixel() != 1:
        raise VolumeError(
            f"{path}: the image is {stored.GetDimension()}-D with {stored.GetNumberOfComponentsPerPixel()} value(s) a "
            "voxel, but a labelmap is 3-D with one"
        )
    # SimpleITK's arrays are indexed [z, y, x].
    values, found = map_values(SimpleITK.GetArrayViewFromImage(stored), options.labels, str(path))
    image = SimpleITK.GetImageFromArray(values)
    image.CopyInformation(stored)
    return image, found


def _read_image(path: Path) -> SimpleITK.Image:
    import SimpleITK

    if not path.name.endswith(".nii.gz"):
        return SimpleITK.ReadImage(str(path))
    # SimpleITK would read the voxels of a `wrist.nii` beside `wrist.nii.gz`.
    with tempfile.TemporaryDirectory() as folder:
        alone = Path(folder, path.name)
        alone.symlink_to(path.absolute())
        return SimpleITK.ReadImage(str(alone))


def _image(labels: NDArray[np.uint8], matrix: FloatArray, path: Path) -> SimpleITK.Image:
    """Return labels over (i, j, k) with their matrix to world coordinates as a SimpleITK image."""
    import SimpleITK

    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    if not np.isfinite(matrix).all() or not (spacing > 0).all():
        raise VolumeError(f"{path}: the matrix to the world is {matrix.tolist()}, but it must be finite, no axis 0")
    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(labels.transpose(2, 1, 0)))
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(matrix[:3, 3].tolist())
    image.SetDirection((matrix[:3, :3] / spacing).ravel().tolist())
    return image


def _in_order(
    image: SimpleITK.Image, options: ReadingOptions, path: Path
) -> tuple[NDArray[np.uint8], FloatArray, FloatArray, FloatArray]:
    """Orient an image, reorder its axes and crop it; return labels, spacing, origin and direction."""
    import SimpleITK

    if options.orientation is not None:
        if not _states_directions(path):
            raise VolumeError(
                f"{path}: orientation is {options.orientation!r}, but the file states no directions to orient it by "
                "(no qform and no sform): store them, as with fslorient, or give the volume's entry orientation: null"
            )
        image = SimpleITK.DICOMOrient(image, options.orientation)
    order = [options.axes.index(axis) for axis in AXES]
    labels = SimpleITK.GetArrayFromImage(image).transpose(2, 1, 0).transpose(order)
    spacing = np.array(image.GetSpacing())[order]
    direction = np.array(image.GetDirection()).reshape(3, 3)[:, order]
    ranges = [_kept(options.crop_mm, axis, labels.shape[i], spacing[i], path) for i, axis in enumerate(AXES)]
    first = np.array([kept.start for kept in ranges])
    origin = np.array(image.GetOrigin()) + direction @ (first * spacing)
    return labels[tuple(ranges)], spacing, origin, direction


def _kept(crop_mm: Crop | None, axis: str, n_voxels: int, step_mm: float, path: Path) -> slice:
    """Return the range of voxels to keep along an axis."""
    if crop_mm is None or axis not in crop_mm:
        return slice(0, n_voxels)
    low, high = crop_mm[axis]
    centres = np.arange(n_voxels)
    inside = np.flatnonzero((centres >= low / step_mm - ON_EDGE) & (centres <= high / step_mm + ON_EDGE))
    if not inside.size:
        raise VolumeError(
            f"{path}: crop_mm of {axis} is [{low:g}, {high:g}], but the voxels' centres lie every {step_mm:g} mm from "
            f"0 to {(n_voxels - 1) * step_mm:g} mm and none is inside"
        )
    return slice(int(inside[0]), int(inside[-1]) + 1)

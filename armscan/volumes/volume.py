"""A labelmap volume, through which the agent moves its plane."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from armscan.errors import InvalidValueError, VolumeError, few, listed, printable
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_int, check_numbers
from armscan.volumes.labelmap import ALLOWED_LABELS, LABEL_NAMES, LANDMARK_LABELS, TISSUE_LABELS, check_whole, shown
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.rigid_transform import RigidTransform
from armscan.volumes.slicing import clearance, occupied_depths, sample_plane

LONGEST_SIDE_PX = 65536
# Far beyond any image, yet slices can still be computed with the ratio of two spacings.
SMALLEST_SPACING_MM, MAX_SPACING_MM = 1e-6, 1e6
# For dot products of direction cosines; files store these with six digits or more.
RIGHT_ANGLE_TOLERANCE = 1e-3
PALM_NOTE = "the palm is at low z{}, in phantoms at high z; orientation in the manifest flips axes"


@dataclass(frozen=True, eq=False, repr=False)
class LabelVolume:
    """An integer labelmap of an arm with its spacing and, if one is known, the plane to find.

    It may be one voxel thick along an axis. A plane outside the volume shows background.

    Args:
        labels: Integers over (x, y, z), shape (nx, ny, nz): X across the palm, Y along the arm, Z through the depth; 0
            background, 1 bones, 2 flexor tendons, 3 ulnar artery, 4 median nerve. Stored as uint8, with Y first in
            memory (`labels_yxz`).
        spacing: Voxel spacing (sx, sy, sz) in mm.
        name: Name of the volume in errors, `info` and tables.
        optimal_action: Labelled plane, in the volume's own frame. Default: None, not known.
        origin: World coordinates (LPS) of voxel (0, 0, 0), in mm. Default: zeros.
        direction: Direction cosines of the array's axes in the world, as columns, shape (3, 3). Default: the identity.
        subject: Name of the person, of whom there may be other volumes. Default: None, this volume is the only one.

    Raises:
        VolumeError: If the labels are not a 3-D array of the labels above, a landmark is missing, the spacing is not
            within 1e-6 to 1e6 mm, `origin` is not a position, or `direction` is not orthonormal.
    """

    labels: NDArray[np.uint8]
    spacing: tuple[float, float, float]
    name: str
    optimal_action: ManipulatorAction | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: FloatArray = field(default_factory=lambda: np.eye(3))
    subject: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise VolumeError(f"the name of a volume is {self.name!r}, but it must be a string")
        if printable(self.name) != self.name:
            raise VolumeError(
                f"the name of a volume is {self.name!r}, but it must be a string without control characters"
            )
        object.__setattr__(self, "labels", _checked_labels(self.labels, self.name))
        object.__setattr__(self, "spacing", _checked_spacing(self.spacing, self.name))
        object.__setattr__(self, "origin", _checked_mm("origin", self.origin, self.name))
        object.__setattr__(self, "direction", _checked_direction(self.direction, self.name))
        if self.optimal_action is not None and not isinstance(self.optimal_action, ManipulatorAction):
            raise VolumeError(
                f"{self.name}: optimal_action is {self.optimal_action!r}, but it must be a ManipulatorAction or None"
            )

    @classmethod
    def from_checked(cls, labels: NDArray[np.uint8], *, direction: FloatArray, fingerprint: str, **rest: Any) -> Self:
        """Return a volume with the labels of an earlier one, which are neither checked nor copied.

        Args:
            labels: `labels` of the earlier volume.
            direction: Direction cosines of the earlier volume.
            fingerprint: `fingerprint` of the earlier volume.
            **rest: Other arguments of `LabelVolume`.
        """
        volume = cls.__new__(cls)
        direction.flags.writeable = False
        vars(volume).update(rest, labels=labels, direction=direction, fingerprint=fingerprint)
        return volume

    def of_subject(self, subject: str | None) -> Self:
        """Return a volume of this subject, with the same labels, which are neither checked nor copied."""
        volume = self.__class__.__new__(self.__class__)
        vars(volume).update(vars(self), subject=subject)
        return volume

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Pickling loses the arrays' memory order and their read-only flags: restore both.
        state["labels"] = np.ascontiguousarray(state["labels"].transpose(1, 0, 2)).transpose(1, 0, 2)
        for array in (state["labels"], state["direction"]):
            array.flags.writeable = False
        self.__dict__.update(state)

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, _: dict[int, object]) -> Self:
        """Return this volume: volumes are immutable and large, and Gymnasium deep-copies arguments."""
        return self

    def __repr__(self) -> str:
        n_x, n_y, n_z = self.shape
        return f"LabelVolume({self.name!r}, {n_x} x {n_y} x {n_z})"

    @property
    def shape(self) -> tuple[int, int, int]:
        """(nx, ny, nz) in voxels."""
        n_x, n_y, n_z = self.labels.shape
        return n_x, n_y, n_z

    @property
    def size_mm(self) -> tuple[float, float, float]:
        """Physical size n * s along each axis, in mm."""
        n_x, n_y, n_z = (n * s for n, s in zip(self.shape, self.spacing, strict=True))
        return n_x, n_y, n_z

    @property
    def labels_yxz(self) -> NDArray[np.uint8]:
        """The labels over (y, x, z), C-contiguous."""
        return self.labels.transpose(1, 0, 2)

    @cached_property
    def fingerprint(self) -> str:
        """The SHA-256 of everything in the volume that affects an agent: voxels, spacing and labelled plane."""
        plane = self.optimal_action
        rest = (self.shape, self.spacing, None if plane is None else plane.to_array().tolist())
        digest = hashlib.sha256(repr(rest).encode())
        digest.update(np.ascontiguousarray(self.labels).data)
        return digest.hexdigest()

    @cached_property
    def has_palm_at_high_z(self) -> bool:
        """Whether the tendons lie at higher z than the bones on average, as in phantoms; true if either is missing."""
        depths = range(self.shape[2])
        of_tissues = ((self.labels == TISSUE_LABELS[each]).sum(axis=(0, 1)) for each in ("bones", "tendons"))
        bones, tendons = (np.average(depths, weights=each) if each.any() else None for each in of_tissues)
        return bones is None or tendons is None or bool(tendons > bones)

    @cached_property
    def centre_mm(self) -> tuple[float, float, float]:
        """The midpoint between the centres of the first and the last voxel, in mm."""
        c_x, c_y, c_z = ((n - 1) * s / 2 for n, s in zip(self.shape, self.spacing, strict=True))
        return c_x, c_y, c_z

    @property
    def slice_centre_mm(self) -> tuple[float, float]:
        """Centre of a slice in the plane's frame, (across, depth) in mm."""
        return self.centre_mm[0], self.centre_mm[2]

    @cached_property
    def slice_shape(self) -> tuple[int, int]:
        """Default shape of a slice: (nx, nz)."""
        return self.shape[0], self.shape[2]

    @cached_property
    def pixel_mm(self) -> tuple[float, float]:
        """Pixel size of a slice: (sx, sz) in mm."""
        return self.spacing[0], self.spacing[2]

    @cached_property
    def occupied(self) -> NDArray[np.int32]:
        """Depths that the labels occupy; see `occupied_depths`."""
        return occupied_depths(self.labels_yxz)

    @cached_property
    def labelled_clearance(self) -> float:
        """Error of the labelled plane's matrix and offset that surely leaves its slice unchanged; see `clearance`."""
        plane = self.optimal_action
        assert plane is not None
        return clearance(self.spacing, plane.matrix, plane.offset_mm, self.slice_shape)

    def slice(
        self,
        action: ManipulatorAction,
        shape: tuple[int, int] | None = None,
        *,
        transform: RigidTransform | None = None,
    ) -> NDArray[np.uint8]:
        """Look up the labels on a plane; nothing is resampled.

        Args:
            action: Plane to slice.
            shape: Number of pixels (across, depth), each from 1 to 65,536. Default: None, (nx, nz).
            transform: Motion T of the volume: the slice is taken from V'(q) = V(T(q)). Default: None, no motion.

        Returns:
            The slice, indexed [across, depth], uint8; 0 if the plane is outside the volume.

        Raises:
            InvalidValueError: If `shape` is not two whole numbers from 1 to 65536, or an argument has the wrong type.
        """
        if not isinstance(action, ManipulatorAction):
            raise InvalidValueError(f"action is {action!r}, but it must be a ManipulatorAction")
        if transform is not None and not isinstance(transform, RigidTransform):
            raise InvalidValueError(f"transform is {transform!r}, but it must be a RigidTransform or None")
        if shape is None:
            shape = self.slice_shape
        elif not isinstance(shape, tuple | list) or len(shape) != 2:
            raise InvalidValueError(f"shape is {shape!r}, but it must be 2 whole numbers (across, depth)")
        for n_pixels in shape:
            check_int(f"each of shape = {shape}", n_pixels, at_least=1, at_most=LONGEST_SIDE_PX)
        if transform is None:
            matrix, offset_mm = action.matrix, action.offset_mm
        else:
            matrix, offset_mm = transform.plane_map(action)
        slice_xz = np.empty(shape, dtype=np.uint8)
        sample_plane(self.labels_yxz, self.occupied, self.spacing, matrix, offset_mm, slice_xz)
        return slice_xz


def _checked_labels(labels: NDArray[np.generic], name: str) -> NDArray[np.uint8]:
    try:
        labels = np.asarray(labels)
    except ValueError as error:
        raise VolumeError(f"{name}: the labels are not an array ({error})") from error
    if labels.ndim != 3 or 0 in labels.shape:
        raise VolumeError(f"{name}: the image has shape {labels.shape}, but a labelmap must be 3-D and not empty")
    whole = check_whole(labels, name)
    if whole.min() < 0 or whole.max() > max(LABEL_NAMES):
        raise VolumeError(f"{name}: holds the values {shown(np.unique(whole).tolist())}, but {ALLOWED_LABELS} only")
    # A copy, so that later changes to the caller's array do not change the volume.
    checked = np.array(whole.transpose(1, 0, 2), dtype=np.uint8, order="C").transpose(1, 0, 2)
    if missing := [f"{label} ({LABEL_NAMES[label]})" for label in LANDMARK_LABELS if not (checked == label).any()]:
        raise VolumeError(
            f"{name}: no voxel is labelled {listed(missing)}, but every landmark is required; "
            "exclude: REASON in its entry of the manifest leaves the volume out"
        )
    checked.flags.writeable = False
    return checked


def _checked_mm(key: str, numbers: Any, name: str) -> tuple[float, float, float]:
    try:
        x, y, z = check_numbers(key, numbers, 3, "(x, y, z) in mm")
    except InvalidValueError as error:
        raise VolumeError(f"{name}: {error}") from error
    return x, y, z


def _checked_spacing(spacing: tuple[float, float, float], name: str) -> tuple[float, float, float]:
    checked = _checked_mm("spacing", spacing, name)
    if min(checked) < SMALLEST_SPACING_MM or max(checked) > MAX_SPACING_MM:
        raise VolumeError(
            f"{name}: spacing is {checked}, but each must be from {SMALLEST_SPACING_MM:g} to {MAX_SPACING_MM:g} mm"
        )
    return checked


def _checked_direction(direction: FloatArray, name: str) -> FloatArray:
    try:
        checked: FloatArray = np.array(direction, dtype=np.float64)
    except (TypeError, ValueError):
        checked = np.empty(0)
    # Written so that NaN fails it, too.
    if checked.shape != (3, 3) or not (np.abs(checked.T @ checked - np.eye(3)) < RIGHT_ANGLE_TOLERANCE).all():
        received = np.array2string(checked, separator=", ").replace("\n", "") if checked.size else repr(direction)
        raise VolumeError(f"{name}: direction is {received}, but its 3 columns must be unit vectors at right angles")
    checked.flags.writeable = False
    return checked


def palm_notes(volumes: Mapping[str, LabelVolume]) -> list[str]:
    """Return a sentence on volumes, by name, whose palm is on the other side than in phantoms; reads all voxels."""
    turned = [name for name, volume in volumes.items() if not volume.has_palm_at_high_z]
    return [PALM_NOTE.format(f" in {few(turned)}")] if turned else []

"""Scene of one episode: a volume, its motion, and where its optimal plane then lies."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from armscan.envs.actions import ActionBounds
from armscan.errors import InvalidValueError, OptimalPlaneError
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_bool, check_choice, check_float
from armscan.volumes.deformation import DeformingTransform
from armscan.volumes.plane import ManipulatorAction, plane_distance, shift_into
from armscan.volumes.rigid_transform import NO_MAPS, RigidTransform, mapped_plane
from armscan.volumes.volume import LabelVolume

MAX_SHIFT_MM = 10_000.0
ROUNDING_DEG = 1e-9
CENTRES = ("middle", "first_voxel")
# Limit of scale, stretch and shear, within which no draw comes near a flat volume.
MAX_DEFORMATION = 0.3
# The axis that each shear shifts, and the one along which it grows: none shifts along the normal, which would move the
# labelled plane.
SHEARED = ((0, 2), (2, 0), (0, 1), (2, 1))


@dataclass(frozen=True, kw_only=True)
class RandomTransform:
    """Random motion and deformation of a volume at reset, each component drawn uniformly.

    Deformations make other wrists of one: they are centred on the labelled slice, keep the labelled plane fixed, and
    cost nothing, because the lookup of a slice applies them. Trainings have them, evaluations do not. The pixel size
    does not change, so that a larger wrist has larger landmarks, in pixels as in mm.

    Args:
        rz_deg: Largest rotation about Z, in degrees, in both directions, from 0 to 180. Default: 10.
        rx_deg: Largest rotation about X, in degrees, in both directions, from 0 to 180. Default: 0.
        tx_mm: Largest translation along X, in mm, in both directions, from 0 to 10,000. Default: 10.
        ty_mm: Largest translation along Y, in mm, in both directions, from 0 to 10,000. Default: 10.
        centre: Fixed point of the rotation: `middle` of the volume, or `first_voxel`, as published, which moves the
            hand out of the picture. Default: `middle`.
        scale: Largest relative change of the volume's size, the same in all directions, from 0 to 0.3; in trainings
            alone. Default: 0.
        stretch: Largest relative change of its size across, along the labelled normal and in depth, each drawn
            separately, from 0 to 0.3; in trainings alone. Default: 0.
        shear: Largest shear, in mm of shift per mm along another axis, from 0 to 0.3: across and depth shift with the
            position along the labelled normal, and with each other; in trainings alone. Default: 0.
        mirror: Whether to mirror the volume with probability 0.5, so that it shows the other hand; in trainings alone.
            Default: False.

    Raises:
        InvalidValueError: If a value is out of its range.
    """

    rz_deg: float = 10.0
    rx_deg: float = 0.0
    tx_mm: float = 10.0
    ty_mm: float = 10.0
    centre: str = "middle"
    scale: float = 0.0
    stretch: float = 0.0
    shear: float = 0.0
    mirror: bool = False

    def __post_init__(self) -> None:
        for name in ("rz_deg", "rx_deg"):
            check_float(f"transform {name}", getattr(self, name), at_least=0.0, at_most=180.0)
        for name in ("tx_mm", "ty_mm"):
            check_float(f"transform {name}", getattr(self, name), at_least=0.0, at_most=MAX_SHIFT_MM)
        check_choice("transform centre", self.centre, CENTRES)
        for name in ("scale", "stretch", "shear"):
            check_float(f"transform {name}", getattr(self, name), at_least=0.0, at_most=MAX_DEFORMATION)
        check_bool("transform mirror", self.mirror)

    @property
    def rigid(self) -> RandomTransform:
        """The same motion without deformation."""
        return replace(self, scale=0.0, stretch=0.0, shear=0.0, mirror=False)

    def draw(self, volume: LabelVolume, rng: np.random.Generator) -> RigidTransform:
        """Draw one motion of a volume, and its deformation if there is one."""
        limits = self.rz_deg, self.rx_deg, self.tx_mm, self.ty_mm
        # The numbers that `rng.uniform` draws with arrays of limits, in a fraction of its time, as plain floats.
        drawn = rng.random(4).tolist()
        rz, rx, tx, ty = (-limit + 2.0 * limit * part for limit, part in zip(limits, drawn, strict=True))
        centre_mm = volume.centre_mm if self.centre == "middle" else (0.0, 0.0, 0.0)
        if not (self.scale or self.stretch or self.shear or self.mirror):
            return RigidTransform((rz, rx), (tx, ty), centre_mm)
        assert volume.optimal_action is not None
        return DeformingTransform(
            (rz, rx),
            (tx, ty),
            centre_mm,
            plane=volume.optimal_action,
            about_mm=volume.slice_centre_mm,
            deformation=self._deformation(rng),
        )

    def _deformation(self, rng: np.random.Generator) -> FloatArray:
        """Draw how a volume is deformed in the frame of its labelled plane (across, along the normal, in depth)."""
        deformation = np.diag(rng.uniform(1.0 - self.stretch, 1.0 + self.stretch, 3))
        deformation *= rng.uniform(1.0 - self.scale, 1.0 + self.scale)
        for row, column in SHEARED:
            deformation[row, column] = rng.uniform(-self.shear, self.shear)
        if self.mirror and rng.random() < 0.5:
            deformation[:, 0] *= -1.0
        return deformation


@dataclass(frozen=True)
class Scene:
    """A volume as it is moved in one episode.

    Args:
        volume: Volume of the episode.
        transform: Motion of the volume; None for none.
        optimum: Optimal plane of the moved volume, in its frame, within the bounds.
        bounds: Bounds of the actions.
    """

    volume: LabelVolume
    transform: RigidTransform | None
    optimum: ManipulatorAction
    bounds: ActionBounds

    @cached_property
    def optimum_normalised(self) -> FloatArray:
        """The optimal plane as a normalised vector, shape (4,)."""
        return self.bounds.normalised(self.optimum)

    @property
    def maps(self) -> FloatArray:
        """The affine maps that take a point into the unmoved volume; see `RigidTransform.maps`."""
        return NO_MAPS if self.transform is None else self.transform.maps

    def plane_map(self, action: ManipulatorAction) -> tuple[FloatArray, FloatArray]:
        """Return (M, b): a point p of the plane's frame lies at M p + b in the unmoved volume."""
        return mapped_plane(self.maps, action.rotation, action.translation)

    def distance(self, action: ManipulatorAction) -> tuple[float, float]:
        """Return how far a plane is from the optimal one, as `plane_distance` does: (mm, degrees)."""
        return plane_distance(action, self.optimum, self.volume.slice_centre_mm)


@dataclass(frozen=True, kw_only=True)
class SceneSampler:
    """Draws the scenes of an environment."""

    rotation_bounds_deg: tuple[float, float]
    translation_bounds_mm: tuple[float, float] | None
    transform: RandomTransform | None

    def __post_init__(self) -> None:
        if self.transform is not None and not isinstance(self.transform, RandomTransform):
            raise InvalidValueError(f"transform is {self.transform!r}, but it must be a RandomTransform or None")

    def bounds(self, volume: LabelVolume) -> ActionBounds:
        """Return the bounds that hold for every scene of a volume."""
        size_mm = volume.size_mm
        return _bounds(self.rotation_bounds_deg, self.translation_bounds_mm or (size_mm[0], size_mm[1]))

    def unmoved(self, volume: LabelVolume) -> Scene:
        """Return the scene of an unmoved volume.

        Raises:
            OptimalPlaneError: If scenes of this volume cannot be drawn, because it has no labelled plane, or the plane
                can be turned out of the rotation bounds, or misses the volume.
        """
        if volume.optimal_action is None:
            raise OptimalPlaneError(
                f"{volume.name}: has no labelled plane, which an environment needs; armscan data label FOLDER finds it"
            )
        turns = (0.0, 0.0) if self.transform is None else (self.transform.rz_deg, self.transform.rx_deg)
        for name, angle, turn, bound in zip(
            ("rz", "rx"), volume.optimal_action.rotation, turns, self.rotation_bounds_deg, strict=True
        ):
            if bound < 180.0 and abs(angle) + turn > bound:
                # Rounded up, so that the bound it names is accepted.
                least = math.ceil(1e6 * (abs(angle) + turn)) / 1e6
                raise OptimalPlaneError(
                    f"{volume.name}: the optimal plane has {name} = {angle:g} degrees and can be turned by {turn:g} "
                    f"more, but the rotation bound is {bound:g}; it must be at least {least:.10g}"
                )
        scene = self._scene(volume, None)
        if scene is None:
            raise OptimalPlaneError(
                f"{volume.name}: the optimal plane, {volume.optimal_action}, misses the volume or its bounds: "
                f"rotations within +-{self.rotation_bounds_deg} degrees, translations from 0 to "
                f"{self.bounds(volume).translation_mm} mm"
            )
        return scene

    def propose(self, volume: LabelVolume, rng: np.random.Generator) -> Scene | None:
        """Draw a motion of the volume; None if it takes the optimal plane out of the bounds."""
        return self._scene(volume, self.transform.draw(volume, rng) if self.transform else None)

    def _scene(self, volume: LabelVolume, transform: RigidTransform | None) -> Scene | None:
        assert volume.optimal_action is not None
        bounds = self.bounds(volume)
        optimum = volume.optimal_action if transform is None else transform.inverse_plane(volume.optimal_action)
        within = shift_into(optimum, bounds.translation_mm)
        rotation = np.clip(optimum.rotation, *np.multiply.outer((-1.0, 1.0), self.rotation_bounds_deg))
        # A plane on the bound may be beyond it by the rounding of the motion.
        if within is None or np.abs(rotation - optimum.rotation).max() > ROUNDING_DEG:
            return None
        return Scene(volume, transform, replace(within, rotation=(float(rotation[0]), float(rotation[1]))), bounds)


def reachable_optimum(volume: LabelVolume) -> ManipulatorAction | None:
    """Return a volume's labelled plane with its origin within the volume; None if that is not possible or not known."""
    sampler = SceneSampler(rotation_bounds_deg=(180.0, 180.0), translation_bounds_mm=None, transform=None)
    try:
        return sampler.unmoved(volume).optimum
    except OptimalPlaneError:
        return None


def shows_labelled(scene: Scene) -> bool:
    """Return whether the optimal plane of a scene shows exactly the slice of the labelled plane.

    It does, up to rounding, for which `labelled_clearance` leaves room, unless the slice was shifted into the bounds or
    turned within the plane by a motion about X, or the volume was deformed.
    """
    labelled = scene.volume.optimal_action
    assert labelled is not None
    matrix, offset_mm = scene.plane_map(scene.optimum)
    off = max(np.abs(matrix - labelled.matrix).max(), np.abs(offset_mm - labelled.offset_mm).max())
    return bool(off < scene.volume.labelled_clearance)


# Checked once, not at every reset.
_bounds = lru_cache(ActionBounds)

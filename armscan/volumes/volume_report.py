"""Summary of a file that was read: its contents, and the volume made of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from armscan.volumes.labelmap import (
    BACKGROUND,
    LABEL_NAMES,
    FoundSource,
    LabelMap,
    Source,
    count_values,
)
from armscan.volumes.orientation import Crop, orientation_of
from armscan.volumes.volume import PALM_NOTE, LabelVolume

# Limits of the longest side of a volume of an arm.
SMALLEST_MM, LARGEST_MM = 20.0, 2000.0


@dataclass(frozen=True, kw_only=True)
class StoredFile:
    """Metadata of a volume's file.

    Args:
        shape: Number of voxels along the file's own axes.
        spacing: Voxel spacing along the file's own axes, in mm.
        orientation: Directions that the file's axes run towards, such as 'LPS'.
        found: Every value or segment, its label and the number of its voxels in the file.
        missing: Values and segments of the label map that the file does not contain.
        crop_mm: Part of the volume that is kept, in mm; None for all.
        has_directions: Whether the file states the directions of its axes; otherwise 'LPS' is assumed.
    """

    shape: tuple[int, ...]
    spacing: tuple[float, ...]
    orientation: str
    found: tuple[FoundSource, ...]
    missing: tuple[Source, ...]
    crop_mm: Crop | None
    has_directions: bool


@dataclass(frozen=True)
class VolumeReport:
    """A volume, after orientation, order of axes, crop and resampling, and the file that it was read from."""

    volume: LabelVolume
    stored: StoredFile

    @property
    def orientation(self) -> str:
        """Directions that the volume's axes run towards, such as 'LPS'."""
        return orientation_of(self.volume.direction)

    @cached_property
    def n_voxels(self) -> dict[str, int]:
        """Number of voxels of each tissue."""
        counts = count_values(self.volume.labels)
        return {tissue: counts.get(label, 0) for label, tissue in LABEL_NAMES.items() if label != BACKGROUND}

    @property
    def notes(self) -> list[str]:
        """Notes on a size that no arm has, and on axes that may differ from those of phantoms, one sentence each."""
        notes, size_mm = [], self.volume.size_mm
        if not self.has_size_of_an_arm:
            sizes = " x ".join(f"{mm:.0f}" if mm >= 10 else f"{mm:.2g}" for mm in size_mm)
            notes.append(f"the volume is {sizes} mm large: is the spacing in its file in mm?")
        if size_mm[1] < max(size_mm):
            sizes = " x ".join(f"{mm:.0f}" for mm in size_mm)
            notes.append(f"y, along the arm, is not the longest of {sizes} mm; axes in the manifest orders them")
        if not self.stored.has_directions:
            notes.append("the file states no directions of its axes (no qform and no sform); LPS is assumed")
        if not self.volume.has_palm_at_high_z:
            notes.append(PALM_NOTE.format(""))
        return notes

    @property
    def has_size_of_an_arm(self) -> bool:
        """Whether an arm can be as long as the longest side."""
        return SMALLEST_MM <= max(self.volume.size_mm) <= LARGEST_MM

    @property
    def tissue_mm3(self) -> dict[str, float]:
        """The tissues' volumes in cubic millimetres."""
        return {tissue: count * math.prod(self.volume.spacing) for tissue, count in self.n_voxels.items()}


def missing_sources(labels: LabelMap | None, found: tuple[FoundSource, ...]) -> tuple[Source, ...]:
    """Return the entries of the label map that the file lacks: values for a plain file, names for a segmentation.

    A number in quotes is a name: it is reported for plain files, too, where a value was meant.
    """
    if labels is None:
        return ()
    there = {each.source for each in found if each.n_voxels}
    by_name = any(isinstance(each.source, str) for each in found)
    return tuple(
        source
        for source in labels.by_source
        if source not in there and (isinstance(source, str) == by_name or (str(source).isdigit() and not by_name))
    )

"""3D Slicer's segmentations (.seg.nrrd): segments by name, in one layer or, if they overlap, in several."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.errors import VolumeError, listed, reason_of
from armscan.utils.arrays import FloatArray
from armscan.volumes.labelmap import BACKGROUND, TISSUE_LABELS, FoundSource, LabelMap, apply_table, count_values, shown

SEGMENTATION_SUFFIX = ".seg.nrrd"
# As slicerio finds them.
SEGMENT_FIELD = re.compile("Segment([0-9]+)_(.+)")
OVERLAPS = ("refuse", "first", "last")


@dataclass(frozen=True)
class Segment:
    """One segment: the voxels of `layer` that have `value`."""

    name: str
    layer: int
    value: int
    label: int


def read_segmentation(
    path: Path, labels: LabelMap | None, overlap: str
) -> tuple[NDArray[np.uint8], FloatArray, tuple[FoundSource, ...]]:
    """Read a segmentation and map its segments to the labels 0 to 4 by their names.

    Segments of one tissue may overlap, and so may a background segment and any other. Where segments of different
    tissues share a voxel, `overlap` decides.

    Args:
        path: File to read.
        labels: Mapping from segments to tissues. None: segments are named after the tissues (bones, tendons, artery,
            nerve, background; upper or lower case).
        overlap: Rule for voxels in segments of different tissues: `refuse` raises, `first` and `last` take the tissue
            of the first or last segment in the file.

    Returns:
        The labels over the file's axes, the 4 x 4 matrix from their indices to world coordinates (left, posterior,
        superior) in mm, and the segments found.

    Raises:
        VolumeError: If the file is damaged, a segment is not mapped, voxels belong to no segment, or segments of
            different tissues overlap and `overlap` is `refuse`.
    """
    contents = _contents(path)
    layers = contents["voxels"]
    if layers.ndim == 3:
        layers = layers[np.newaxis]
    if layers.ndim != 4 or 0 in layers.shape or not np.issubdtype(layers.dtype, np.integer):
        raise VolumeError(
            f"{path}: the image has shape {layers.shape} and values of type {layers.dtype}, but a segmentation has "
            "layers of 3-D whole numbers"
        )
    counts = [count_values(layer) for layer in layers]
    segments = _segments(contents["segments"], len(layers), labels, path)
    _check_strays(segments, counts, labels, path)
    found = tuple(FoundSource(each.name, each.label, counts[each.layer].get(each.value, 0)) for each in segments)
    if len(layers) == 1:
        # A value that does not occur may not fit the voxels' data type.
        table = dict.fromkeys(counts[0], BACKGROUND)
        table |= {each.value: each.label for each in segments if each.value in table}
        return apply_table(layers[0], table), contents["ijkToLPS"], found
    return _merged(layers, segments, overlap, path), contents["ijkToLPS"], found


def _contents(path: Path) -> dict[str, Any]:
    # Deferred: few files are segmentations.
    import slicerio

    try:
        contents: dict[str, Any] = slicerio.read_segmentation(str(path))
    # slicerio and pynrrd raise exceptions of many types on a damaged file.
    except Exception as error:
        raise VolumeError(
            f"{path}: the file is truncated or damaged, or no segmentation ({reason_of(error)})"
        ) from error
    if not contents["segments"]:
        raise VolumeError(f"{path}: the file names no segment (Segment0_Name, ...), but a segmentation needs some")
    for segment, name in zip(contents["segments"], _names(path), strict=True):
        segment["name"] = segment["id"] if name is None else name
    return contents


def _names(path: Path) -> list[str | None]:
    """Return the names of the segments in slicerio's order, None without a name; slicerio keeps ASCII alone."""
    import nrrd

    with path.open(encoding="utf-8", errors="surrogateescape") as file:
        fields = [(SEGMENT_FIELD.fullmatch(key), value) for key, value in nrrd.read_header(file).items()]
    names = dict[int, str | None]()
    for found, value in fields:
        if found is not None:
            names.setdefault(int(found[1]), None)
            if found[2] == "Name":
                names[int(found[1])] = value
    for name in names.values():
        if name is not None and not name.isprintable():
            raise VolumeError(f"{path}: has the segment {name!a}, but a name must be printable text in UTF-8")
    return [names[number] for number in sorted(names)]


def _segments(stored: list[dict[str, Any]], n_layers: int, labels: LabelMap | None, path: Path) -> list[Segment]:
    """Return the segments in the order of the file; each must be mapped, and have its own value in its layer."""
    segments, unnamed, places = [], [], set()
    for position, each in enumerate(stored):
        name = str(each["name"])
        # Before Slicer 4.11 each segment had a layer of its own, with the value 1.
        layer, value = each.get("layer", position), each.get("labelValue", 1)
        if not 0 <= layer < n_layers or value == 0 or (layer, value) in places:
            raise VolumeError(
                f"{path}: segment {name!r} has the value {value} in layer {layer}, but it must have a value of its own "
                f"that is not 0, in one of the {n_layers} layer(s) from 0"
            )
        places.add((layer, value))
        label = TISSUE_LABELS.get(name.casefold()) if labels is None else labels.label_of(name)
        if label is None:
            unnamed.append(name)
        else:
            segments.append(Segment(name, layer, value, label))
    if unnamed:
        if labels is None:
            raise VolumeError(
                f"{path}: has the segments {shown(unnamed)}, but without a label map they must be called "
                f"{listed(TISSUE_LABELS)}"
            )
        raise VolumeError(
            f"{path}: has the segments {shown(unnamed)}, which the label map does not name; every segment must be "
            "named, or others must be background"
        )
    return segments


def _check_strays(segments: list[Segment], counts: list[dict[int, int]], labels: LabelMap | None, path: Path) -> None:
    """Raise `VolumeError` if voxels belong to no segment, unless the label map makes others background."""
    if labels is not None and labels.others == "background":
        return
    for layer, present in enumerate(counts):
        known = {0} | {each.value for each in segments if each.layer == layer}
        if strays := [value for value in present if value not in known]:
            raise VolumeError(f"{path}: holds {shown(strays)} in layer {layer}, but no segment has that value there")


def _merged(layers: NDArray[Any], segments: list[Segment], overlap: str, path: Path) -> NDArray[np.uint8]:
    merged = np.zeros(layers.shape[1:], dtype=np.uint8)
    tissues = [each for each in segments if each.label != BACKGROUND]
    for position, each in enumerate(tissues):
        voxels = layers[each.layer] == each.value
        taken = voxels & (merged != BACKGROUND) & (merged != each.label)
        if overlap == "refuse" and taken.any():
            other = next(
                before
                for before in tissues[:position]
                if before.label != each.label and (taken & (layers[before.layer] == before.value)).any()
            )
            raise VolumeError(
                f"{path}: the segments {other.name!r} and {each.name!r} overlap, but a voxel is of one tissue; "
                "overlap: first or last says which of them it belongs to, in the order of the file"
            )
        merged[voxels & (merged == BACKGROUND) if overlap == "first" else voxels] = each.label
    return merged

"""Mapping from the values or segments of a file to tissues."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from numbers import Integral
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from armscan.errors import InvalidValueError, VolumeError, few, listed
from armscan.utils.validation import check_choice

LABEL_NAMES = {0: "background", 1: "bones", 2: "tendons", 3: "artery", 4: "nerve"}
LANDMARK_LABELS = (1, 2, 3)
ALLOWED_LABELS = "a labelmap holds " + ", ".join(f"{label} {tissue}" for label, tissue in LABEL_NAMES.items())
TISSUE_LABELS = {name: label for label, name in LABEL_NAMES.items()}
BACKGROUND = TISSUE_LABELS["background"]
# Tissues that every labelmap must have.
LANDMARKS = ("bones", "tendons", "artery")
# A narrower range of values is looked up in a dense table, a wider one by binary search.
MAX_TABLE = 65536
LARGEST_INT64 = 2**63 - 1
# Integers up to this are exact in a 64-bit float.
MAX_FLOAT_LABEL = 2**53
MAX_SHOWN = 8

# What a file calls a tissue: a voxel's value, or the name of a segment.
Source = int | str


@dataclass(frozen=True)
class LabelMap:
    """Mapping from values (of plain labelmaps) or segment names (of .seg.nrrd files) to tissues.

    Several sources may map to one tissue: segmentations often number each bone separately. The value 0 is background
    unless a tissue lists it.

    Args:
        bones: Values and segment names of the bones, in a list or tuple.
        tendons: Values and segment names of the flexor tendons.
        artery: Values and segment names of the ulnar artery.
        nerve: Values and segment names of the median nerve. Default: none.
        background: Values and segment names to ignore. Default: none.
        others: `background` maps every other value to background. Default: None, a file with other values is refused.

    Raises:
        InvalidValueError: If a source is neither a whole number nor a string, or is listed twice, or a landmark (bones,
            tendons, artery) has no source.
    """

    bones: tuple[Source, ...] = ()
    tendons: tuple[Source, ...] = ()
    artery: tuple[Source, ...] = ()
    nerve: tuple[Source, ...] = ()
    background: tuple[Source, ...] = ()
    others: str | None = None

    def __post_init__(self) -> None:
        for tissue in TISSUE_LABELS:
            object.__setattr__(self, tissue, _checked_sources(tissue, getattr(self, tissue)))
        for tissue in LANDMARKS:
            if not getattr(self, tissue):
                raise InvalidValueError(f"labels: {tissue} is empty, but every landmark is required")
        check_choice("labels: others", self.others, (None, "background"))
        seen: dict[Source, str] = {}
        for tissue in TISSUE_LABELS:
            for source in getattr(self, tissue):
                if source in seen:
                    raise InvalidValueError(
                        f"labels: {source!r} is {seen[source]} and {tissue}, but it must be listed once"
                    )
                seen[source] = tissue

    @classmethod
    def from_mapping(cls, mapping: Any) -> Self:
        """Build a label map from a manifest's entry, {'bones': [1, 2], ...}."""
        allowed = [field.name for field in fields(cls)]
        if not isinstance(mapping, Mapping):
            raise InvalidValueError(f"labels is {mapping!r}, but it must be a mapping with {', '.join(allowed)}")
        if unknown := [key for key in mapping if key not in allowed]:
            raise InvalidValueError(f"labels has the key {unknown[0]!r}, but only {listed(allowed)} are known")
        return cls(**mapping)

    @cached_property
    def by_source(self) -> dict[Source, int]:
        """The label, 0 to 4, of each listed source."""
        return {source: label for tissue, label in TISSUE_LABELS.items() for source in getattr(self, tissue)}

    def label_of(self, source: Source) -> int | None:
        """Return the label, 0 to 4, of a value or segment; None if the map does not name it and refuses others."""
        unnamed = BACKGROUND if self.others == "background" or source == 0 else None
        return self.by_source.get(source, unnamed)


@dataclass(frozen=True)
class FoundSource:
    """A value or segment found in a file.

    Args:
        source: Voxel value, or name of the segment.
        label: Label that it maps to, 0 to 4.
        n_voxels: Number of its voxels in the file; 0 for an empty segment.
    """

    source: Source
    label: int
    n_voxels: int


def map_values(
    values: NDArray[np.generic], labels: LabelMap | None, where: str
) -> tuple[NDArray[np.uint8], tuple[FoundSource, ...]]:
    """Map a file's values to the labels 0 to 4.

    Args:
        values: Whole numbers of any type, in a non-empty array of any shape.
        labels: Mapping from values to labels; None if the values are already the labels 0 to 4.
        where: Name of the file, for errors.

    Returns:
        The labels, of the same shape, and the values found, in ascending order.

    Raises:
        VolumeError: If the values are not whole numbers, or the label map does not name one of them.
    """
    whole = check_whole(values, where)
    counts = count_values(whole)
    table = {value: (labels or STANDARD_LABELS).label_of(value) for value in counts}
    if unnamed := [value for value, label in table.items() if label is None]:
        if labels is None:
            raise VolumeError(
                f"{where}: holds the values {shown(counts)}, but {ALLOWED_LABELS} only; if it is no image, map "
                "them to tissues in the folder's manifest.yaml: labels: {bones: [...], tendons: [...], artery: [...]}"
            )
        is_quoted = any(str(value) in labels.by_source for value in unnamed)
        hint = " (a number in quotes is the name of a segment)" if is_quoted else ""
        raise VolumeError(
            f"{where}: holds {shown(unnamed)}, which the label map does not name{hint}; every value must be named, or "
            "others must be background"
        )
    named = {value: label for value, label in table.items() if label is not None}
    return apply_table(whole, named), tuple(FoundSource(value, named[value], counts[value]) for value in counts)


def count_values(values: NDArray[np.integer[Any]]) -> dict[int, int]:
    """Return the number of voxels of each value that occurs, by value in ascending order."""
    low, high = int(values.min()), int(values.max())
    if high - low >= MAX_TABLE or high > LARGEST_INT64:
        present, n_voxels = np.unique(values, return_counts=True)
        return dict(zip(map(int, present), map(int, n_voxels), strict=True))
    counts = np.zeros(high - low + 1, dtype=np.int64)
    # Slab by slab: keeps the copies small, and is ten times as fast.
    for slab in values:
        counts += np.bincount((slab.astype(np.int64) - low).ravel(), minlength=counts.size)
    return {low + int(position): int(counts[position]) for position in np.flatnonzero(counts)}


def apply_table(values: NDArray[np.integer[Any]], table: Mapping[int, int]) -> NDArray[np.uint8]:
    """Return the label that `table` gives for each value; every value that occurs must be in it."""
    known = sorted(table)
    low, high = known[0], known[-1]
    labels = np.array([table[value] for value in known], dtype=np.uint8)
    if high - low >= MAX_TABLE or high > LARGEST_INT64:
        return np.asarray(labels[np.searchsorted(np.array(known, dtype=values.dtype), values)])
    dense = np.zeros(high - low + 1, dtype=np.uint8)
    dense[np.array(known) - low] = labels
    mapped = np.empty(values.shape, dtype=np.uint8)
    for position, slab in enumerate(values):
        mapped[position] = dense[slab.astype(np.int64) - low]
    return mapped


def check_landmarks(found: tuple[FoundSource, ...], labels: LabelMap, where: str) -> None:
    """Raise `VolumeError` unless the file has voxels of every landmark."""
    there = {each.label for each in found if each.n_voxels}
    missing = [tissue for tissue in LANDMARKS if TISSUE_LABELS[tissue] not in there]
    if missing:
        named = listed(f"{tissue} ({shown(getattr(labels, tissue))})" for tissue in missing)
        raise VolumeError(
            f"{where}: no voxel is {named} by the label map, but every landmark must be there; the file holds "
            f"{shown([each.source for each in found])}"
        )


def shown(sources: Iterable[Source]) -> str:
    """Format the first few values or names for a message."""
    return few(map(repr, sources), MAX_SHOWN)


def check_whole(values: NDArray[np.generic], where: str) -> NDArray[np.integer[Any]]:
    """Return integer or whole-valued float voxels as integers; raise `VolumeError` for any others."""
    if np.issubdtype(values.dtype, np.integer):
        return values  # type: ignore[return-value]
    if not np.issubdtype(values.dtype, np.floating):
        raise VolumeError(f"{where}: holds values of type {values.dtype}, but a labelmap holds whole numbers")
    low, high = values.min(), values.max()
    # Written so that NaN fails it, too.
    if not (abs(low) <= MAX_FLOAT_LABEL and abs(high) <= MAX_FLOAT_LABEL and (values == np.floor(values)).all()):
        raise VolumeError(
            f"{where}: holds {values.dtype} values between {low:g} and {high:g} that are not whole numbers: grey "
            "values? A labelmap holds whole numbers only"
        )
    return values.astype(np.int64)


def _checked_sources(tissue: str, sources: Any) -> tuple[Source, ...]:
    if not isinstance(sources, list | tuple) or not all(map(_is_source, sources)):
        raise InvalidValueError(
            f"labels: {tissue} is {sources!r}, but it must be a list of whole numbers and names of segments"
        )
    return tuple(source if isinstance(source, str) else int(source) for source in sources)


def _is_source(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, Integral) and not isinstance(value, bool))


STANDARD_LABELS = LabelMap(bones=(1,), tendons=(2,), artery=(3,), nerve=(4,))

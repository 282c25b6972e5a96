"""Which values or segments of a file are which tissue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from numbers import Integral
from typing import Any, Self

from armscan.errors import InvalidValueError, listed
from armscan.volumes.volume import LABEL_NAMES

TISSUE_LABELS = {name: label for label, name in LABEL_NAMES.items()}
BACKGROUND = TISSUE_LABELS["background"]
# Up to this many different values lie in one table, which is looked up rather than searched.
LARGEST_TABLE = 65536
# The whole numbers up to here are exact as 64-bit floats.
LARGEST_FLOAT_LABEL = 2**53
MAX_SHOWN = 8

# What a file calls a tissue: a voxel's value, or the name of a segment.
Source = int | str


@dataclass(frozen=True)
class LabelMap:
    """Which values (of plain labelmaps) or segments by name (of .seg.nrrd files) are which tissue.

    Several sources may be one tissue: segmentations often number every bone by itself. The value 0 is background where
    no tissue names it.

    Args:
        bones: whole numbers and names of segments, in a list or tuple.
        tendons: likewise; the flexor tendons.
        artery: likewise; the ulnar artery.
        nerve: likewise; the median nerve.
        background: likewise; what is in the file but of no interest.
        others: `background` makes everything else background; None refuses a file that holds anything else.

    Raises:
        InvalidValueError: if a source is neither a whole number nor a text, stands twice, or a landmark (bones,
            tendons, artery) has none.
    """

    bones: tuple[Source, ...]
    tendons: tuple[Source, ...]
    artery: tuple[Source, ...]
    nerve: tuple[Source, ...] = ()
    background: tuple[Source, ...] = ()
    others: str | None = None

    def __post_init__(self) -> None:
        for tissue in TISSUE_LABELS:
            object.__setattr__(self, tissue, _checked_sources(tissue, getattr(self, tissue)))
        for tissue in ("bones", "tendons", "artery"):
            if not getattr(self, tissue):
                raise InvalidValueError(f"labels: {tissue} is empty, but every landmark must be there")
        if self.others not in (None, "background"):
            raise InvalidValueError(f"labels: others is {self.others!r}, but it must be 'background' or left out")
        seen: dict[Source, str] = {}
        for tissue in TISSUE_LABELS:
            for source in getattr(self, tissue):
                if source in seen:
                    raise InvalidValueError(
                        f"labels: {source!r} is {seen[source]} and {tissue}, but it must stand once"
                    )
                seen[source] = tissue

    @classmethod
    def from_mapping(cls, mapping: Any) -> Self:
        """Builds a label map from what a manifest says, {'bones': [1, 2], ...}.

        Raises:
            InvalidValueError: if it is no mapping, or a key is unknown or missing, and as the class says.
        """
        allowed = [field.name for field in fields(cls)]
        if not isinstance(mapping, Mapping):
            raise InvalidValueError(f"labels is {mapping!r}, but it must be a mapping with {', '.join(allowed)}")
        if unknown := [key for key in mapping if key not in allowed]:
            raise InvalidValueError(f"labels has the key {unknown[0]!r}, but only {listed(allowed)} are known")
        if missing := [tissue for tissue in ("bones", "tendons", "artery") if tissue not in mapping]:
            raise InvalidValueError(f"labels has no {missing[0]}, but every landmark must be there")
        return cls(**mapping)

    @cached_property
    def by_source(self) -> dict[Source, int]:
        """The label, 0 to 4, of each source that is named."""
        return {source: label for tissue, label in TISSUE_LABELS.items() for source in getattr(self, tissue)}

    def label_of(self, source: Source) -> int | None:
        """Returns the label, 0 to 4, of what a file holds; None where the map does not name it and refuses others."""
        unnamed = BACKGROUND if self.others == "background" or source == 0 else None
        return self.by_source.get(source, unnamed)


def _checked_sources(tissue: str, sources: Any) -> tuple[Source, ...]:
    if not isinstance(sources, list | tuple) or not all(map(_is_source, sources)):
        raise InvalidValueError(
            f"labels: {tissue} is {sources!r}, but it must be a list of whole numbers and names of segments"
        )
    return tuple(source if isinstance(source, str) else int(source) for source in sources)


def _is_source(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, Integral) and not isinstance(value, bool))


STANDARD_LABELS = LabelMap(bones=(1,), tendons=(2,), artery=(3,), nerve=(4,))

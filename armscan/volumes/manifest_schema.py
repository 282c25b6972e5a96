"""What a manifest may say. Loaded only when one is read; `docs/manifest.md` is the page for those who write one."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from armscan.errors import InvalidValueError
from armscan.utils.validation import check_float, check_numbers
from armscan.volumes.labelmap import LabelMap
from armscan.volumes.orientation import Crop, check_axes, check_crop, check_orientation
from armscan.volumes.plane import ManipulatorAction


def _rotation(value: Any) -> tuple[float, ...]:
    return check_numbers("rotation", value, 2, "(rz, rx) in degrees")


def _translation(value: Any) -> tuple[float, ...]:
    return check_numbers("translation", value, 2, "(tx, ty) in mm")


def _score(value: Any) -> float:
    return check_float("score", value, at_least=-1.0, at_most=0.0)


def _subjects(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not value or not all(isinstance(name, str) and name for name in value):
        raise InvalidValueError(f"a split is {value!r}, but it must be a list of at least one subject (texts)")
    return tuple(value)


Axes = Annotated[str, BeforeValidator(check_axes)]
Orientation = Annotated[str | None, BeforeValidator(check_orientation)]
Labels = Annotated[LabelMap, BeforeValidator(LabelMap.from_mapping)]
Overlap = Literal["refuse", "first", "last"]
OVERLAP_MEANING = "refuse, first or last"


class _Strict(BaseModel):
    """Takes no other keys, and no value for another one."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True)


class VolumeEntry(_Strict):
    """What a manifest says about one volume; each description is what the key's value must be."""

    rotation: Annotated[tuple[float, ...], BeforeValidator(_rotation)] | None = None
    translation: Annotated[tuple[float, ...], BeforeValidator(_translation)] | None = None
    score: Annotated[float, BeforeValidator(_score)] | None = None
    subject: str | None = Field(default=None, min_length=1, description="a text that is not empty (quote numbers)")
    exclude: bool | Annotated[str, Field(min_length=1)] = Field(default=False, description="true, false or the reason")
    labels: Labels | None = None
    orientation: Orientation = None
    axes: Axes = "xyz"
    crop_mm: Annotated[Crop | None, BeforeValidator(check_crop)] = None
    overlap: Overlap = Field(default="refuse", description=OVERLAP_MEANING)

    @model_validator(mode="after")
    def _has_whole_plane(self) -> VolumeEntry:
        if (self.rotation is None) != (self.translation is None):
            there, lacking = ("rotation", "translation") if self.translation is None else ("translation", "rotation")
            raise InvalidValueError(f"has no {lacking}, but a plane needs it beside its {there}")
        return self

    @property
    def plane(self) -> ManipulatorAction | None:
        """The labelled plane, None where the entry has none."""
        if self.rotation is None or self.translation is None:
            return None
        return ManipulatorAction((self.rotation[0], self.rotation[1]), (self.translation[0], self.translation[1]))


class Splits(_Strict):
    """Which subjects are for what."""

    train: Annotated[tuple[str, ...], BeforeValidator(_subjects)] = ()
    validation: Annotated[tuple[str, ...], BeforeValidator(_subjects)] = ()
    test: Annotated[tuple[str, ...], BeforeValidator(_subjects)] = ()

    @model_validator(mode="after")
    def _has_no_subject_twice(self) -> Splits:
        seen: dict[str, str] = {}
        for split in type(self).model_fields:
            for subject in getattr(self, split):
                if subject in seen:
                    raise InvalidValueError(f"has the subject {subject!r} in {seen[subject]} and in {split}")
                seen[subject] = split
        return self


class Manifest(_Strict):
    """A whole manifest; what stands at the top holds for every volume whose entry says nothing else."""

    labels: Labels | None = None
    orientation: Orientation = None
    axes: Axes = "xyz"
    overlap: Overlap = Field(default="refuse", description=OVERLAP_MEANING)
    spacing: Literal["own", "finest"] = Field(default="own", description="own or finest")
    splits: Splits | None = Field(default=None, description="lists of subjects under train, validation and test")
    volumes: dict[str, VolumeEntry] | None = Field(default=None, description="entries by the names of the files")

    def setting(self, entry: VolumeEntry, key: str) -> Any:
        """Return what holds for a volume: its own value where its entry has the key, else the one for all."""
        return getattr(entry if key in entry.model_fields_set else self, key)

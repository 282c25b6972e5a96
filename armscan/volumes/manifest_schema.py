"""Schema of a manifest, loaded only when one is read; `docs/manifest.md` describes it for users."""

from __future__ import annotations

import reprlib
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, ValidationError, model_validator

from armscan.errors import InvalidValueError, ManifestError, listed, printable
from armscan.utils.section import Section
from armscan.utils.text import appearance
from armscan.utils.validation import check_float, check_numbers
from armscan.volumes.labelmap import LabelMap
from armscan.volumes.orientation import Crop, check_axes, check_crop, check_orientation
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.resampling import Spacing

# Of each volume, or the finest of all along each axis.
SPACINGS = ("own", "finest")


def _printable(text: str) -> str:
    if printable(text) != text:
        raise InvalidValueError(f"holds {text!r}, but a string must be without control characters")
    return text


def _named(text: str) -> str:
    if text != text.strip():
        raise InvalidValueError(f"is {text!r}, but a subject must not begin or end with a blank")
    return _printable(text)


def _reason(text: str) -> str:
    if text.lower() in ("n", "no", "off", "false", "y", "yes", "on", "true"):
        raise InvalidValueError(f"exclude is the string {text!r}, but it must be true, false or the reason")
    return text


def _subjects(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not value or not all(isinstance(name, str) and name for name in value):
        raise InvalidValueError(f"a split is {value!r}, but it must be a list of at least one subject (strings)")
    return tuple(value)


def _spacing(value: Any) -> str | Spacing:
    if isinstance(value, str) and value in SPACINGS:
        return value
    if not isinstance(value, list | tuple):
        raise InvalidValueError(f"spacing is {value!r}, but it must be {listed([*SPACINGS, '(sx, sy, sz) in mm'])}")
    s_x, s_y, s_z = check_numbers("spacing", value, 3, "(sx, sy, sz) in mm")
    if min(s_x, s_y, s_z) <= 0:
        raise InvalidValueError(f"spacing is {[s_x, s_y, s_z]}, but each must be above 0")
    return s_x, s_y, s_z


Rotation = Annotated[
    tuple[float, ...], BeforeValidator(partial(check_numbers, "rotation", length=2, meaning="(rz, rx) in degrees"))
]
Translation = Annotated[
    tuple[float, ...], BeforeValidator(partial(check_numbers, "translation", length=2, meaning="(tx, ty) in mm"))
]
Score = Annotated[float, BeforeValidator(partial(check_float, "score", at_least=-1.0, at_most=0.0))]
Text = Annotated[str, AfterValidator(_printable)]
Reason = Annotated[Text, Field(min_length=1), AfterValidator(_reason)]
Subject = Annotated[str, AfterValidator(_named)]
Axes = Annotated[str, BeforeValidator(check_axes)]
Orientation = Annotated[str | None, BeforeValidator(check_orientation)]
Labels = Annotated[LabelMap, BeforeValidator(LabelMap.from_mapping)]
Overlap = Literal["refuse", "first", "last"]


class _Settings(Section):
    """Keys allowed in an entry and at the top of a manifest."""

    labels: Labels | None = None
    orientation: Orientation = None
    axes: Axes = "xyz"
    overlap: Overlap = Field(default="refuse", description="refuse, first or last")


class VolumeEntry(_Settings):
    """Entry of a manifest for one volume."""

    rotation: Rotation | None = None
    translation: Translation | None = None
    score: Score | None = None
    found_by: Text | None = None
    subject: Subject | None = Field(
        default=None, min_length=1, description="a string that is not empty (quote numbers)"
    )
    exclude: bool | Reason = Field(default=False, description="true, false or the reason")
    crop_mm: Annotated[Crop | None, BeforeValidator(check_crop)] = None

    @model_validator(mode="after")
    def _has_whole_plane(self) -> VolumeEntry:
        if (self.rotation is None) != (self.translation is None):
            there, lacking = ("rotation", "translation") if self.translation is None else ("translation", "rotation")
            raise InvalidValueError(f"has no {lacking}, but a plane needs it beside its {there}")
        return self

    @property
    def plane(self) -> ManipulatorAction | None:
        """The labelled plane, None if the entry has none."""
        if self.rotation is None or self.translation is None:
            return None
        return ManipulatorAction((self.rotation[0], self.rotation[1]), (self.translation[0], self.translation[1]))


class Splits(Section):
    """Subjects of each split."""

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


class Manifest(_Settings):
    """A whole manifest; keys at the top are the defaults of every volume's entry."""

    spacing: Annotated[str | Spacing, BeforeValidator(_spacing)] = "own"
    splits: Splits | None = Field(default=None, description="lists of subjects under train, validation and test")
    volumes: dict[Text, VolumeEntry] | None = Field(default=None, description="entries by the names of the files")

    @model_validator(mode="after")
    def _has_no_lookalikes(self) -> Manifest:
        names = [entry.subject for entry in (self.volumes or {}).values() if entry.subject is not None]
        first: dict[str, str] = {}
        for name in names:
            if (other := first.setdefault(appearance(name), name)) != name:
                raise InvalidValueError(f"has two spellings of a subject that look alike: {other!a}, {name!a}")
        return self

    def setting(self, entry: VolumeEntry, key: str) -> Any:
        """Return a volume's value of a key: from its own entry, else from the top of the manifest."""
        return getattr(entry if key in entry.model_fields_set else self, key)


def check_manifest(document: dict[str, Any], path: Path) -> Manifest:
    """Return the checked manifest; raise `ManifestError` if a value is not allowed."""
    try:
        return Manifest.model_validate(document)
    except ValidationError as error:
        raise ManifestError(_in_one_line(error, path)) from error
    # A document that contains itself, or is nested too deeply.
    except RecursionError as error:
        raise ManifestError(f"{path}: the manifest is nested too deeply") from error


def _in_one_line(error: ValidationError, path: Path) -> str:
    """Describe the first mistake: the file, the entry, the key, the value received and the allowed values."""
    mistake = error.errors(include_url=False)[0]
    kind, received, place = mistake["type"], reprlib.repr(mistake["input"]), list(mistake["loc"])
    model: type[BaseModel] = Manifest
    part = ""
    if place[:1] == ["volumes"] and len(place) > 1:
        part, model, place = f"entry {place[1]!r}", VolumeEntry, place[2:]
    elif place[:1] == ["splits"] and (len(place) > 1 or kind == "value_error"):
        part, model, place = "splits", Splits, place[1:]
    key = f"{path}: {part}: " if part else f"{path}: "
    whole = f"{path}: {part} " if part else f"{path}: "
    known = listed(model.model_fields)
    if kind == "extra_forbidden":
        return f"{whole}has the key {place[-1]!r}, but only {known} are known"
    if kind == "value_error":
        return f"{key if place else whole}{mistake['ctx']['error']}"
    if not place:
        return f"{whole}is {received}, but it must be an object with some of {known}"
    field = model.model_fields.get(str(place[0]))
    allowed = (field.description if field else None) or "a string"
    return f"{key}{place[0]} is {received}, but it must be {allowed}"

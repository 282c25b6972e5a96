"""A folder of labelmaps with a manifest that describes them."""

from __future__ import annotations

import shlex
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from armscan.errors import ManifestError, VolumeError, few, listed
from armscan.utils.validation import check_choice, check_int, check_path
from armscan.volumes.manifest import (
    MANIFEST_NAMES,
    SHARED_KEYS,
    find_manifest,
    read_manifest,
    volume_entries,
    volume_files,
)
from armscan.volumes.read_cache import read_cached, resample_cached
from armscan.volumes.reading import ReadingOptions
from armscan.volumes.resampling import finest_spacing, is_same_spacing
from armscan.volumes.volume import LabelVolume
from armscan.volumes.volume_report import VolumeReport

if TYPE_CHECKING:
    from armscan.volumes.manifest_schema import Manifest, Splits, VolumeEntry

SPLITS = ("train", "validation", "test")
Key = TypeVar("Key", bound=Hashable)
T = TypeVar("T")


@dataclass(frozen=True)
class Dataset:
    """The volumes of a folder, described by its manifest.

    Args:
        volumes: Volumes by file name, without the excluded ones.
        reports: Summary of each file, and of the volume made from it, by file name.
        splits: Split of each volume (`train`, `validation` or `test`), by file name. Default: None, the manifest has no
            splits.
        excluded: Reason why a volume of the folder was left out, by file name. Default: none.
        manifest: Manifest that the volumes were read with. Default: None, unknown.
        found_by: MLflow run ID of the agent that found a volume's plane, by file name. Default: none, no agent did.
    """

    volumes: dict[str, LabelVolume]
    reports: dict[str, VolumeReport]
    splits: dict[str, str] | None = None
    excluded: dict[str, str] = field(default_factory=dict)
    manifest: Manifest | None = None
    found_by: dict[str, str] = field(default_factory=dict)

    @property
    def subjects(self) -> dict[str, str]:
        """Subject of each volume, by file name; a volume without one is its own subject."""
        return {name: volume.subject or name for name, volume in self.volumes.items()}

    def volumes_of(self, split: str) -> dict[str, LabelVolume]:
        """Return the volumes of `train`, `validation` or `test` by file name; none if there are no splits."""
        check_choice("split", split, SPLITS)
        return {name: volume for name, volume in self.volumes.items() if self.splits and self.splits[name] == split}


def read_dataset(path: str | Path) -> dict[str, LabelVolume]:
    """Read every volume of a folder: the `volumes` of `open_dataset`."""
    return open_dataset(path).volumes


def open_dataset(path: str | Path, *, require_manifest: bool = True) -> Dataset:
    """Read every volume of a folder as its manifest says.

    Args:
        path: Folder of the volumes. `docs/manifest.md` describes its manifest: `manifest.yaml`, `manifest.yml` or
            `manifest.json`. `optimal_actions.json`, an object with the volumes' entries only, is read too.
        require_manifest: Whether to refuse a folder without a manifest, instead of reading it as if its manifest were
            empty. Default: True.

    Returns:
        The volumes in the order of their names, and their metadata.

    Raises:
        VolumeError: If the folder or a file cannot be used.
        ManifestError: If the manifest is missing or damaged, or does not name the folder's volumes.
    """
    found, manifest, files = _manifest_of(path, require_manifest=require_manifest)
    entries = volume_entries(manifest, files, found)
    used = {name: entry for name, entry in entries.items() if not entry.exclude}
    if not used:
        raise ManifestError(f"{found}: excludes every volume of the folder")
    volumes, stored, errors = {}, {}, {}
    for name, entry in used.items():
        options = ReadingOptions(crop_mm=entry.crop_mm, **{key: manifest.setting(entry, key) for key in SHARED_KEYS})
        try:
            volumes[name], stored[name] = read_cached(files[name], options, optimal_action=entry.plane)
        except VolumeError as error:
            errors[name] = error
    if errors:
        (_, first), *others = errors.items()
        more = f"; these cannot be read either: {few(name for name, _ in others)}" if others else ""
        raise VolumeError(f"{first}{more}") from first
    if manifest.spacing != "own":
        spacing = finest_spacing(volumes.values()) if isinstance(manifest.spacing, str) else manifest.spacing
        volumes = {name: resample_cached(volume, spacing) for name, volume in volumes.items()}
    volumes = {name: volume.of_subject(used[name].subject) for name, volume in volumes.items()}
    subjects = {name: entry.subject or name for name, entry in entries.items()}
    splits = None if manifest.splits is None else _split_of(manifest.splits, subjects, used, f"{found}: splits")
    return Dataset(
        volumes=volumes,
        reports={name: VolumeReport(volume, stored[name]) for name, volume in volumes.items()},
        splits=splits,
        excluded={name: str(entry.exclude) for name, entry in entries.items() if entry.exclude},
        manifest=manifest,
        found_by=_found_by(used),
    )


def planes_found_by(path: str | Path) -> dict[str, str]:
    """Return the MLflow run ID of the agent that found a volume's plane, by file name, without reading a volume."""
    found, manifest, files = _manifest_of(path, require_manifest=True)
    entries = volume_entries(manifest, files, found)
    return _found_by({name: entry for name, entry in entries.items() if not entry.exclude})


def _found_by(entries: Mapping[str, VolumeEntry]) -> dict[str, str]:
    return {name: entry.found_by for name, entry in entries.items() if entry.found_by and entry.plane}


def subjects_in(path: str | Path, n_volumes: int | None = None) -> list[str]:
    """Return the subject of each volume of a folder from its manifest, without reading a volume.

    Args:
        path: Folder of the volumes.
        n_volumes: Number of volumes to include; see `first_volumes`. Default: None, all.

    Raises:
        VolumeError: If the folder cannot be read.
        ManifestError: If it has no manifest, or a damaged one.
        InvalidValueError: If `n_volumes` is not allowed.
    """
    found, manifest, files = _manifest_of(path, require_manifest=True)
    entries = volume_entries(manifest, files, found)
    used = {name: entry.subject or name for name, entry in entries.items() if not entry.exclude}
    return [*first_volumes(used, n_volumes).values()]


def first_volumes(volumes: Mapping[str, T], n_volumes: int | None) -> dict[str, T]:
    """Return the first volumes by name.

    Args:
        volumes: Volumes, or what belongs to them, by file name.
        n_volumes: Their number, `data.n_volumes` of the configuration; None: all.

    Raises:
        InvalidValueError: If `n_volumes` is not a whole number from 1 to the number of volumes.
    """
    if n_volumes is not None:
        check_int("data.n_volumes", n_volumes, at_least=1, at_most=len(volumes))
    return {name: volumes[name] for name in sorted(volumes)[:n_volumes]}


def _split_of(splits: Splits, subjects: Mapping[str, str], used: Mapping[str, object], where: str) -> dict[str, str]:
    """Return the split of each volume; `subjects` also holds those whose volumes are all excluded."""
    split_of = {subject: split for split in SPLITS for subject in getattr(splits, split)}
    if unknown := [subject for subject in split_of if subject not in subjects.values()]:
        raise ManifestError(
            f"{where} names {few(unknown)}, but the subjects are {few(dict.fromkeys(subjects.values()))}"
        )
    if left_out := [name for name in used if subjects[name] not in split_of]:
        raise ManifestError(
            f"{where} does not name {subjects[left_out[0]]!r}, the subject of {left_out[0]}, but every subject must be "
            "in one split (or its volumes excluded)"
        )
    return {name: split_of[subjects[name]] for name in used}


def _manifest_of(path: str | Path, *, require_manifest: bool) -> tuple[Path | None, Manifest, dict[str, Path]]:
    """Return the path and contents of a folder's manifest (None and an empty one if missing), and its volume files."""
    from armscan.volumes.manifest_schema import Manifest

    folder = check_path("the folder of volumes", path)
    files = volume_files(folder)
    found = find_manifest(folder)
    if found is not None:
        return found, read_manifest(found), files
    if require_manifest:
        names = listed(MANIFEST_NAMES)
        command = f"armscan data label {shlex.quote(str(folder))}"
        raise ManifestError(f"{folder}: the folder has no manifest ({names}); {command} writes one")
    return None, Manifest(), files


def check_copies(volumes: Mapping[str, LabelVolume]) -> None:
    """Raise `VolumeError` if two volumes of different subjects have the same voxels: a wrist would count twice."""
    for other, name in copies_among(volumes):
        check_copy(volumes, other, name)


def check_copy(volumes: Mapping[str, LabelVolume], other: str, name: str) -> None:
    """Raise `VolumeError` if a volume, a copy of another one, has another subject."""
    if (volumes[other].subject or other) != (volumes[name].subject or name):
        raise VolumeError(
            f"{name} is a copy of {other}, but has another subject: give both the same subject in the manifest, or "
            "remove one"
        )


def copies_among(volumes: Mapping[Key, LabelVolume]) -> Iterator[tuple[Key, Key]]:
    """Yield the keys of each pair of volumes with the same voxels; their labelled planes may differ."""
    # Only volumes with the same sample of voxels are compared in full.
    seen: dict[Hashable, list[Key]] = {}
    for key, volume in volumes.items():
        similar = seen.setdefault((volume.shape, volume.labels_yxz[::16].tobytes()), [])
        yield from (
            (other, key)
            for other in similar
            if is_same_spacing(volumes[other].spacing, volume.spacing)
            and np.array_equal(volumes[other].labels_yxz, volume.labels_yxz)
        )
        similar.append(key)

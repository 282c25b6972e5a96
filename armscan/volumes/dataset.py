"""A folder of labelmaps with a manifest that gives the optimal plane of each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from armscan.checks import check_path
from armscan.errors import InvalidValueError, ManifestError, VolumeError, listed
from armscan.volumes.headers import CHECKS
from armscan.volumes.plane import ManipulatorAction
from armscan.volumes.reading import read_volume, volume_suffix
from armscan.volumes.volume import LabelVolume

MANIFEST_NAME = "optimal_actions.json"
REQUIRED_KEYS = ("rotation", "translation")
OPTIONAL_KEYS = ("axes",)


def read_dataset(path: str | Path) -> dict[str, LabelVolume]:
    """Reads every volume of a folder, each with its labelled optimal plane.

    The manifest `optimal_actions.json` is an object with one entry for each volume file of the folder, named by the
    file: `rotation`, (rz, rx) in degrees, `translation`, (tx, ty) in mm, and, where the file's axes are not across,
    along and depth in this order, `axes` as in `read_volume`.

    Args:
        path: the folder.

    Returns:
        The volumes by file name, in the order of their names.

    Raises:
        VolumeError: if the folder or a file cannot be used.
        ManifestError: if the manifest is missing or damaged, or does not name the folder's volumes.
    """
    folder = check_path("the folder of volumes", path)
    try:
        if not folder.is_dir():
            what = "is a file, not a folder" if folder.exists() else "does not exist"
            raise VolumeError(f"{folder}: the folder of volumes {what}")
        files = {file.name: file for file in sorted(folder.iterdir()) if file.is_file() and volume_suffix(file)}
    except OSError as error:
        raise VolumeError(f"{folder}: the folder of volumes cannot be read ({error.strerror})") from error
    if not files:
        raise VolumeError(f"{folder}: the folder holds no volume (files ending in {listed(CHECKS)})")
    manifest = folder / MANIFEST_NAME
    entries = _read_manifest(manifest)
    if missing := [name for name in entries if name not in files]:
        raise ManifestError(f"{manifest}: has an entry for {listed(missing)}, but the folder holds no such volume")
    if unlisted := [name for name in files if name not in entries]:
        raise ManifestError(f"{manifest}: has no entry for {listed(unlisted)}, which is in the folder")
    planes = {name: _parse_plane(entries[name], f"{manifest}: entry {name!r}") for name in files}
    return {
        name: read_volume(file, optimal_action=planes[name], axes=entries[name].get("axes", "xyz"))
        for name, file in files.items()
    }


def _read_manifest(manifest: Path) -> dict[str, Any]:
    try:
        entries = json.loads(manifest.read_text(encoding="utf-8"), object_pairs_hook=_without_duplicates)
    except FileNotFoundError as error:
        raise ManifestError(f"{manifest}: the manifest with the volumes' optimal planes does not exist") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ManifestError(f"{manifest}: the manifest cannot be read as JSON ({error})") from error
    if not isinstance(entries, dict):
        raise ManifestError(
            f"{manifest}: is a {type(entries).__name__}, but it must be an object with an entry a volume"
        )
    return entries


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuses what JSON allows and everybody regrets: a key that is there twice, the first one forgotten."""
    entries = dict(pairs)
    if len(entries) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key {max(names, key=names.count)!r} is there twice")
    return entries


def _parse_plane(entry: Any, where: str) -> ManipulatorAction:
    if not isinstance(entry, dict):
        raise ManifestError(f"{where} is {entry!r}, but it must be an object with {listed(REQUIRED_KEYS)}")
    if missing := [key for key in REQUIRED_KEYS if key not in entry]:
        raise ManifestError(f"{where} has no {listed(missing)}")
    if unknown := [key for key in entry if key not in REQUIRED_KEYS + OPTIONAL_KEYS]:
        raise ManifestError(
            f"{where} has the key {unknown[0]!r}, but only {listed(REQUIRED_KEYS + OPTIONAL_KEYS)} are known"
        )
    if not isinstance(entry.get("axes", ""), str):
        raise ManifestError(f"{where}: axes is {entry['axes']!r}, but it must be a text such as 'xyz'")
    try:
        return ManipulatorAction(entry["rotation"], entry["translation"])
    except InvalidValueError as error:
        raise ManifestError(f"{where}: {error}") from error

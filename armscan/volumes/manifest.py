"""Find, read and check a folder's manifest; write planes into it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from filelock import AcquireReturnProxy, FileLock
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from yaml.representer import SafeRepresenter

from armscan.errors import InvalidValueError, ManifestError, VolumeError, few, listed, reason_of
from armscan.utils.files import atomic_write, cache_folder, sha256
from armscan.utils.strict_yaml import check_no_duplicates, load_yaml
from armscan.utils.text import looks_like_one_of
from armscan.utils.validation import check_float, check_path
from armscan.volumes.header_checks import CHECKS
from armscan.volumes.plane import ManipulatorAction

if TYPE_CHECKING:
    from armscan.volumes.manifest_schema import Manifest, VolumeEntry

# The last one is an older format: only the entries of the volumes.
MANIFEST_NAMES = ("manifest.yaml", "manifest.yml", "manifest.json", "optimal_actions.json")
ENTRIES_ONLY = MANIFEST_NAMES[-1]
NEW_MANIFEST = MANIFEST_NAMES[0]
# Key of the agent that has found a plane.
FOUND_BY = "found_by"
SUFFIXES = (".yaml", ".yml", ".json")
# Keys allowed both in an entry and at the top of a manifest.
SHARED_KEYS = ("labels", "orientation", "axes", "overlap")

Document = dict[str, Any]


def volume_files(folder: Path) -> dict[str, Path]:
    """Return the volumes of a folder by file name, in the order of their names."""
    try:
        named = [file for file in sorted(folder.iterdir()) if file.name.lower().endswith(tuple(CHECKS))]
        found = [file for file in named if file.is_file()]
    except FileNotFoundError as error:
        raise VolumeError(f"{folder}: the folder of volumes does not exist") from error
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise VolumeError(f"{folder}: the folder of volumes cannot be read ({reason})") from error
    if absent := [file for file in named if file.is_symlink() and not file.exists()]:
        raise VolumeError(f"{absent[0]}: is a link to {str(absent[0].readlink())!r}, but that file does not exist")
    if capital := [file for file in found if not file.name.endswith(tuple(CHECKS))]:
        raise VolumeError(f"{capital[0]}: ends in capitals, but the end of a volume's name must be {listed(CHECKS)}")
    if not found:
        raise VolumeError(
            f"{folder}: the folder holds no volume (files ending in {listed(CHECKS)}); folders below it are not read"
        )
    return {file.name: file for file in found}


def find_manifest(folder: Path) -> Path | None:
    """Return the one manifest of a folder, None if there is none; refuse a link that leads nowhere."""
    # A dangling link counts, too: writing a new manifest through it could create a file anywhere.
    found = [folder / name for name in MANIFEST_NAMES if os.path.lexists(folder / name)]
    if len(found) > 1:
        raise ManifestError(f"{folder}: holds {' and '.join(path.name for path in found)}, but one manifest is allowed")
    if found and not found[0].exists():
        raise ManifestError(f"{found[0]}: is a link to {str(found[0].readlink())!r}, but that file does not exist")
    return found[0] if found else None


def read_manifest(path: Path) -> Manifest:
    """Read and check a manifest; errors name the file, the entry, the key, the value and the allowed values."""
    # Deferred: phantoms have no manifest.
    from armscan.volumes.manifest_schema import check_manifest

    return check_manifest(_load(path), path)


def volume_entries(manifest: Manifest, files: Mapping[str, Path], path: Path | None) -> dict[str, VolumeEntry]:
    """Return the entry of each volume file: required if the manifest has `volumes`, else empty."""
    from armscan.volumes.manifest_schema import VolumeEntry

    if manifest.volumes is None:
        return {name: VolumeEntry() for name in files}
    if lookalikes := [name for name in manifest.volumes if name not in files and looks_like_one_of(name, files)]:
        raise ManifestError(
            f"{path}: has an entry for {few(lookalikes)}, which the folder holds in another Unicode form, with accents "
            "joined to their letters or apart: copy the name from the folder"
        )
    if missing := [name for name in manifest.volumes if name not in files]:
        raise ManifestError(f"{path}: has an entry for {few(missing)}, but the folder holds no such volume")
    if unlisted := [name for name in files if name not in manifest.volumes]:
        raise ManifestError(f"{path}: has no entry for {few(unlisted)}, which is in the folder")
    return {name: manifest.volumes[name] for name in files}


def record_planes(
    folder: str | Path,
    planes: Mapping[str, tuple[ManipulatorAction, float]],
    *,
    found_by: str | None = None,
    read_with: Manifest | None = None,
) -> Path:
    """Write optimal planes into the manifest of a folder, leaving everything else in it unchanged.

    A folder without a manifest gets `manifest.yaml`. The file is written atomically; comments in YAML are kept.

    Args:
        folder: Folder of the volumes.
        planes: Labelled plane and its reward in [-1, 0], by file name; the plane is in the frame of the volume that
            `open_dataset` returns.
        found_by: MLflow run ID of the agent that found the planes. Default: None, no agent did.
        read_with: Manifest that these volumes were read with, for an error if their settings have changed since.
            Default: None, no such check.

    Returns:
        The manifest.

    Raises:
        InvalidValueError: If `planes` is not such a mapping, or a score is not in [-1, 0].
        ManifestError: If the manifest is damaged or cannot be written, if the folder holds no such volume, or if a
            volume would now be read in another way.
        VolumeError: If the folder cannot be used.
    """
    folder = check_path("the folder of volumes", folder)
    recorded = {name: {**keys, FOUND_BY: found_by} for name, keys in _checked_planes(planes).items()}
    files = volume_files(folder)
    if unknown := [name for name in recorded if name not in files]:
        raise ManifestError(f"{folder}: a plane is given for {few(unknown)}, but the folder holds {few(files)}")
    with _locked(folder):
        return _recorded(folder, recorded, files, read_with)


def _locked(folder: Path) -> AcquireReturnProxy:
    """Lock a folder, and return the context that releases it: concurrent writers would overwrite each other."""
    # The lock lies in the cache, so that none is left in the folder; other users of a shared cache may lock it, too.
    path = cache_folder() / f"manifest-{sha256(os.fsencode(folder.resolve()))[:16]}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return FileLock(path, mode=0o666).acquire()
    except OSError as error:
        raise ManifestError(f"{path}: the manifest of {folder} cannot be locked ({error.strerror or error})") from error


def _recorded(
    folder: Path, recorded: dict[str, dict[str, Any]], files: dict[str, Path], read_with: Manifest | None
) -> Path:
    """Write the keys of each volume's entry into the manifest; return its path."""
    from armscan.volumes.manifest_schema import check_manifest

    found = find_manifest(folder)
    path = found or folder / NEW_MANIFEST
    target = path.resolve()
    if target.suffix not in SUFFIXES:
        raise ManifestError(f"{path}: is a link to {str(target)!r}, but a plane is written only to {listed(SUFFIXES)}")
    document = _load(path) if found else {}
    manifest = check_manifest(document, path)
    if read_with is not None:
        changed = [name for name in recorded if _reading_of(manifest, name) != _reading_of(read_with, name)]
        if changed:
            raise ManifestError(
                f"{path}: its settings for {few(changed)} have changed since; search for the plane again"
            )
    entries = document.get("volumes")
    entries = {name: {} for name in files} if entries is None else entries
    entries = {**entries, **{name: _updated({**entries.get(name, {})}, keys) for name, keys in recorded.items()}}
    document = {**document, "volumes": entries}
    try:
        if path.suffix == ".json":
            text = json.dumps(entries if path.name == ENTRIES_ONLY else document, indent=1) + "\n"
        else:
            before = path.read_bytes().decode("utf-8-sig") if found else ""
            text = _edited(before.replace("\r\n", "\n"), recorded, document)
            # The editor's lines end in \n.
            text = text.replace("\n", "\r\n") if "\r\n" in before else text
        atomic_write(path, text, follow_link=True)
    # ruamel.yaml refuses some odd texts that PyYAML reads, with exceptions of many types.
    except Exception as error:
        raise ManifestError(f"{path}: the manifest cannot be written ({error})") from error
    return path


def _reading_of(manifest: Manifest, name: str) -> tuple[Any, ...]:
    """Return all that determines the frame of a volume."""
    from armscan.volumes.manifest_schema import VolumeEntry

    entry = (manifest.volumes or {}).get(name) or VolumeEntry()
    return manifest.spacing, entry.crop_mm, *(manifest.setting(entry, key) for key in SHARED_KEYS)


def _edited(text: str, recorded: dict[str, Document], wanted: Document) -> str:
    """Return the text of a YAML manifest with recorded keys written into it; raise if it is not read as `wanted`."""
    editor = _round_trip()
    document = editor.load(text) or {}
    if document.get("volumes") is None:
        document["volumes"] = {name: {} for name in wanted["volumes"]}
    entries = document["volumes"]
    for name, keys in recorded.items():
        entry = entries.get(name, {})
        # Other entries may be aliases of one with an anchor: they stay as they are.
        has_anchor = isinstance(entry, CommentedMap) and entry.anchor.value is not None
        entries[name] = entry.copy() if has_anchor else entry
        _updated(entries[name], keys)
    edited = StringIO()
    editor.dump(document, edited)
    if load_yaml(edited.getvalue()) != wanted:
        raise ValueError("its anchors, aliases or merged keys would change other values: write them out")
    return edited.getvalue()


def _updated(entry: Document, keys: Mapping[str, Any]) -> Document:
    """Update an entry with the keys of a plane; one that no agent has found loses the key of the agent."""
    entry.update({key: value for key, value in keys.items() if value is not None})
    if keys[FOUND_BY] is None:
        entry.pop(FOUND_BY, None)
    return entry


def _checked_planes(planes: Any) -> dict[str, Document]:
    if not isinstance(planes, Mapping):
        raise InvalidValueError(f"planes is {planes!r}, but it must be planes with their scores by file name")
    recorded = {}
    for name, pair in planes.items():
        if not isinstance(pair, tuple) or len(pair) != 2 or not isinstance(pair[0], ManipulatorAction):
            raise InvalidValueError(
                f"the plane of {name!r} is {pair!r}, but it must be a ManipulatorAction and its score"
            )
        recorded[name] = {
            "rotation": list(pair[0].rotation),
            "translation": list(pair[0].translation),
            "score": check_float(f"the score of {name!r}", pair[1], at_least=-1.0, at_most=0.0),
        }
    return recorded


def _load(path: Path) -> Document:
    """Read the file, JSON or YAML, without validation."""
    is_json = path.suffix == ".json"
    # A pipe or a device would be read for ever.
    if path.exists() and not path.is_file():
        raise ManifestError(f"{path}: the manifest is not a file, or a link to one")
    try:
        text = path.read_text(encoding="utf-8-sig")
        document = json.loads(text, object_pairs_hook=_without_duplicates) if is_json else load_yaml(text)
    except OSError as error:
        raise ManifestError(f"{path}: the manifest cannot be read ({error.strerror or error})") from error
    # On some damaged texts PyYAML raises exceptions of other types: KeyError, AttributeError, ...
    except Exception as error:
        reason = reason_of(error)
        if isinstance(error, yaml.MarkedYAMLError):
            # Without PyYAML's excerpt of the text.
            mark = error.problem_mark
            where = "" if mark is None else f" in line {mark.line + 1}, column {mark.column + 1}"
            reason = f"{error.problem or error.context}{where}"
        raise ManifestError(
            f"{path}: the manifest cannot be read as {'JSON' if is_json else 'YAML'} ({reason})"
        ) from error
    if document is None and not is_json:
        # An empty file, or nothing but comments.
        document = {}
    if not isinstance(document, dict):
        raise ManifestError(f"{path}: is a {type(document).__name__}, but it must be an object with keys and values")
    return {"volumes": document} if path.name == ENTRIES_ONLY else document


def _without_duplicates(pairs: list[tuple[str, Any]]) -> Document:
    """Build an object, refusing duplicate keys, of which `json` would keep the last."""
    check_no_duplicates([key for key, _ in pairs])
    return dict(pairs)


def _round_trip() -> YAML:
    """Return a reader and writer of YAML that keeps comments, order and quotes."""
    editor = YAML()
    editor.preserve_quotes, editor.width = True, 4096
    # Manifests are read as YAML 1.1, in which a number with an exponent needs a dot.
    editor.representer.add_representer(float, SafeRepresenter.represent_float)
    return editor

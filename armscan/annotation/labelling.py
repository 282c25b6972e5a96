"""Label a folder: find or read a plane for each volume, and write it into the manifest and as a picture."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from armscan.anatomy import FoundPlane, LandmarkReward, PlaneScorer, Tissues, find_optimal_plane
from armscan.envs.rendering import ReferencePlane, draw_plane, view_of
from armscan.errors import ArmscanError, InvalidValueError, ManifestError, MarkupError, OptimalPlaneError, listed
from armscan.utils.console import print_sentence
from armscan.utils.files import atomic_write
from armscan.volumes import (
    Dataset,
    LabelVolume,
    ManipulatorAction,
    open_dataset,
    read_markup,
    record_planes,
    write_markup,
)
from armscan.volumes.manifest import find_manifest
from armscan.volumes.markups import MARKUP_SUFFIX
from armscan.volumes.plane import shift_into

# Largest difference, in mm and degrees, of two planes that are the same: writing and reading a file rounds.
SAME = 1e-3
# Finds the plane of a volume.
Search = Callable[[LabelVolume], FoundPlane]


@dataclass(frozen=True, kw_only=True)
class LabellingOptions:
    """Volumes to label, and options of the search.

    Args:
        data: Folder of the volumes.
        tissues: Clustering rule of each tissue.
        volumes: File names of the volumes to label. Default: None, all.
        overwrite: Whether to label volumes that already have a plane. Default: False.
        pictures: Folder for the pictures; created if it does not exist.
        markups: Whether to write a markups file for 3D Slicer beside each picture. Default: False.
        markup: Markups file with the plane of `volume`, which replaces the search. Default: None.
        volume: Name of the volume that `markup` is for; it may already have a plane. Default: None.
        search: Function that finds the plane of a volume. Default: None, `find_optimal_plane`.
        found_by: MLflow run ID of the agent that `search` applies. Default: None, no agent.
    """

    data: Path
    tissues: Tissues
    volumes: tuple[str, ...] | None = None
    overwrite: bool = False
    pictures: Path
    markups: bool = False
    markup: Path | None = None
    volume: str | None = None
    search: Search | None = None
    found_by: str | None = None


def label(options: LabellingOptions) -> tuple[list[tuple[LabelVolume, FoundPlane]], list[ArmscanError]]:
    """Find or read a plane for each volume, draw it and write it into the manifest, volume by volume.

    Returns:
        The volumes, with the plane that each had before, and their planes now in the manifest; and an error for each
        volume in which no plane was found.
    """
    dataset = open_dataset(options.data, require_manifest=False)
    volumes = _wanted(options, dataset)
    if options.markups and options.markup is None:
        _write_known_markups(options, dataset.volumes, set(volumes))
    find = _search(options)
    if options.overwrite and any(volume.optimal_action is not None for volume in volumes.values()):
        _keep_manifest(options.data)
    labelled: list[tuple[LabelVolume, FoundPlane]] = []
    failures: list[ArmscanError] = []
    for number, (name, volume) in enumerate(volumes.items(), 1):
        print(f"{number}/{len(volumes)}  {name}", flush=True)
        try:
            plane = find(volume)
        # InvalidValueError: the clustering rules, or the agent, do not suit the volume.
        except (OptimalPlaneError, InvalidValueError) as error:
            failures.append(error if name in str(error) else InvalidValueError(f"{name}: {error}"))
            continue
        # The manifest last: no plane is written into it without a picture.
        _make_folder(options.pictures)
        _write_picture(options.pictures / f"{name}.png", volume, plane.action, options.tissues)
        if options.markups:
            _write_markup(options.pictures, volume, plane.action)
        planes = {name: (plane.action, plane.score)}
        record_planes(options.data, planes, found_by=options.found_by, read_with=dataset.manifest)
        labelled.append((volume, plane))
    return labelled, failures


def _keep_manifest(folder: Path) -> None:
    """Copy the manifest, whose planes are about to be replaced: a person may have corrected them."""
    manifest = find_manifest(folder)
    assert manifest is not None, "a volume has a plane"
    kept = manifest.with_name(f"{manifest.name}.{datetime.now():%Y-%m-%d_%H-%M-%S}.bak")
    try:
        shutil.copyfile(manifest, kept)
    except OSError as error:
        raise ManifestError(f"{kept}: the former planes cannot be kept there ({error.strerror})") from error
    print(f"the former planes are kept in {kept}")


def _wanted(options: LabellingOptions, dataset: Dataset) -> dict[str, LabelVolume]:
    """Return the volumes to label, by file name."""
    names = (options.volume,) if options.volume is not None else options.volumes
    if names is None:
        wanted = dataset.volumes
    else:
        if unknown := [name for name in names if name not in dataset.volumes]:
            raise InvalidValueError(f"the volume is {unknown[0]!r}, but it must be {listed(dataset.volumes)}")
        wanted = {name: dataset.volumes[name] for name in names}
    if options.overwrite or options.markup is not None:
        return wanted
    return {name: volume for name, volume in wanted.items() if volume.optimal_action is None}


def _search(options: LabellingOptions) -> Search:
    """Return the function that finds or reads the plane of a volume."""
    if options.markup is not None:
        return partial(_drawn, options.markup, options.tissues)
    return options.search or partial(find_optimal_plane, clustering=options.tissues)


def _drawn(markup: Path, tissues: Tissues, volume: LabelVolume) -> FoundPlane:
    action = read_markup(markup, volume)
    return FoundPlane(action, *PlaneScorer(volume, LandmarkReward(), tissues).score(action))


def _write_known_markups(options: LabellingOptions, volumes: dict[str, LabelVolume], to_label: set[str]) -> None:
    """Write the existing planes that are not searched for again, so that they can be corrected too."""
    for name, volume in volumes.items():
        is_asked_for = options.volumes is None or name in options.volumes
        if is_asked_for and name not in to_label and volume.optimal_action is not None:
            _make_folder(options.pictures)
            _write_markup(options.pictures, volume, volume.optimal_action)


def _write_markup(folder: Path, volume: LabelVolume, action: ManipulatorAction) -> None:
    """Write a plane as a markups file, unless a person has moved the plane in the file that is there."""
    path = folder / f"{volume.name}{MARKUP_SUFFIX}"
    known = [action] if volume.optimal_action is None else [action, volume.optimal_action]
    if path.exists() and not _holds_one_of(path, volume, known):
        print_sentence(
            f"note: {path} holds another plane, or none, and is left as it is: read it back with --markup, or delete it"
        )
        return
    write_markup(path, volume, action)


def _holds_one_of(path: Path, volume: LabelVolume, planes: Sequence[ManipulatorAction]) -> bool:
    try:
        stored = read_markup(path, volume).to_array()
    # A file that cannot be read may be a person's, too.
    except MarkupError:
        return False
    within = (shift_into(each, volume.size_mm[:2]) or each for each in planes)
    return any(np.allclose(stored, each.to_array(), rtol=0.0, atol=SAME) for each in within)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidValueError(
            f"--pictures is {folder}, but no folder can be made there ({error.strerror})"
        ) from error


def _write_picture(path: Path, volume: LabelVolume, action: ManipulatorAction, tissues: Tissues) -> None:
    """Draw the slice, and the plane from two sides, together with the plane that the volume had before, if any."""
    reference = None if volume.optimal_action is None else ReferencePlane(volume.optimal_action, "former plane")
    picture = Image.fromarray(draw_plane(volume, action, view_of(volume, action, tissues=tissues), reference=reference))
    try:
        atomic_write(path, lambda file: picture.save(file, "PNG"))
    except OSError as error:
        raise InvalidValueError(f"{path}: the picture cannot be written ({error.strerror or error})") from error

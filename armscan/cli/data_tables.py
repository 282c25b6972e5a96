"""Tables of the volumes in a folder, and of the planes found in them, for `armscan data`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Column, Table
from rich.text import Text

from armscan.config.command_hints import armscan_command
from armscan.errors import few, listed
from armscan.utils.console import WHOLE_CHARS, print_sentence, print_table, wide_console
from armscan.utils.run_files import ID_CHARS
from armscan.utils.text import MISSING, counted

if TYPE_CHECKING:
    from armscan.anatomy import FoundPlane
    from armscan.annotation.labelling import LabellingOptions
    from armscan.volumes import Dataset, LabelVolume
    from armscan.volumes.volume_report import VolumeReport

# Folder of pictures within the folder of the data.
PICTURES = "labelling"
LABELLED, UNLABELLED = "a labelled plane", "no labelled plane"
# Names of files that are listed.
N_LISTED = 8


def print_dataset(dataset: Dataset, folder: Path) -> None:
    """Print a table for each volume, and the excluded volumes."""
    from armscan.volumes.dataset import copies_among
    from armscan.volumes.manifest import MANIFEST_NAMES

    # Lines of a file or a pipe are never wrapped.
    console = wide_console(WHOLE_CHARS)
    planes = {name: _plane_of(report.volume) for name, report in dataset.reports.items()}
    for name, report in dataset.reports.items():
        split = f"for {dataset.splits[name]}, " if dataset.splits else ""
        by = f" (found by the agent of run {agent[:ID_CHARS]})" if (agent := dataset.found_by.get(name)) else ""
        console.print(Text(f"{name}: subject {dataset.subjects[name]}, {split}{planes[name]}{by}", style="bold"))
        console.print(Text(_geometry(report)))
        console.print(_tissue_table(report))
        for note in (*report.notes, *(_coarse_note(report.volume) if report.has_size_of_an_arm else ())):
            console.print(Text(f"note: {note}"))
    read = {*dataset.reports, *dataset.excluded, *MANIFEST_NAMES, PICTURES}
    if others := sorted(each.name for each in folder.iterdir() if each.name not in read and each.name[0] != "."):
        console.print(Text(f"not read: {few(others, N_LISTED)}"))
    for name, reason in dataset.excluded.items():
        console.print(Text(f"{name}: excluded" + ("" if reason == "True" else f" ({reason})")))
    for other, name in copies_among(dataset.volumes):
        if dataset.subjects[name] != dataset.subjects[other]:
            console.print(Text(f"note: {name} is a copy of {other}: give both the same subject, or remove one"))
    n_volumes, n_subjects = len(dataset.reports), len(set(dataset.subjects.values()))
    n_labelled = sum(plane != UNLABELLED for plane in planes.values())
    n_wrong = sum(plane not in (LABELLED, UNLABELLED) for plane in planes.values())
    wrong = f" ({n_wrong} of them must be corrected, see above)" if n_wrong else ""
    console.print(
        f"{counted(n_volumes, 'volume')} of {counted(n_subjects, 'subject')}, "
        f"{n_labelled} with a labelled plane{wrong}",
        style="bold",
        highlight=False,
    )
    if n_labelled < n_volumes:
        console.print(Text(f"find the missing planes: {armscan_command('data', 'label', str(folder))}"))


def _plane_of(volume: LabelVolume) -> str:
    from armscan.anatomy import PIXEL_TISSUES, SUCCESS_THRESHOLD, LandmarkReward, PlaneScorer, is_coarse
    from armscan.envs.scene import reachable_optimum
    from armscan.volumes.labelmap import LANDMARKS, TISSUE_LABELS

    if volume.optimal_action is None:
        return UNLABELLED
    if (plane := reachable_optimum(volume)) is None:
        return f"{LABELLED} that misses the volume"
    labels = volume.slice(plane)
    missing = [tissue for tissue in LANDMARKS if TISSUE_LABELS[tissue] not in labels]
    if missing:
        return f"{LABELLED} that shows no {listed(missing)}"
    score, _ = PlaneScorer(volume, LandmarkReward(), PIXEL_TISSUES).score(plane)
    # Scores of coarse pixels say little.
    if score > -SUCCESS_THRESHOLD or is_coarse(volume.pixel_mm):
        return LABELLED
    return f"{LABELLED} that scores {score:.3f}, and an environment requires more than {-SUCCESS_THRESHOLD:g}"


def _coarse_note(volume: LabelVolume) -> list[str]:
    """Return a note if pixels are too large to be clustered by pixels, as is the default."""
    from armscan.anatomy import USUAL_PIXEL_MM, is_coarse

    if not is_coarse(volume.pixel_mm):
        return []
    (usual_across, usual_depth), (across, depth) = USUAL_PIXEL_MM, volume.pixel_mm
    return [
        f"pixels of {across:.3g} x {depth:.3g} mm are coarse: clusters merge, so planes many degrees apart get the "
        f"same score; spacing: [{usual_across}, {usual_across}, {usual_depth}] in the manifest resamples the volumes"
    ]


def _tissue_table(report: VolumeReport) -> Table:
    """Return a row for each tissue: its values in the file, and how much of it the volume holds."""
    from armscan.volumes import LABEL_NAMES
    from armscan.volumes.labelmap import shown

    numbers = (Column(name, justify="right", no_wrap=True) for name in ("voxels", "mm³"))
    table = Table(Column("tissue", no_wrap=True), "in the file (voxels)", *numbers)
    for value, tissue in LABEL_NAMES.items():
        sources = ", ".join(f"{each.source} ({each.n_voxels})" for each in report.stored.found if each.label == value)
        is_there = tissue in report.n_voxels
        amounts = (str(report.n_voxels[tissue]), f"{report.tissue_mm3[tissue]:.0f}") if is_there else ()
        table.add_row(tissue, Text(sources or MISSING), *amounts)
    if report.stored.missing:
        table.add_row("missing", Text(shown(report.stored.missing)))
    return table


def _geometry(report: VolumeReport) -> str:
    stored, volume = report.stored, report.volume
    parts = [f"{_grid(volume.shape, volume.spacing)}, axes towards {report.orientation}"]
    before = (stored.shape, stored.spacing, stored.orientation)
    if before != (volume.shape, volume.spacing, report.orientation):
        parts.append(f"read from {_grid(stored.shape, stored.spacing)}, axes towards {stored.orientation}")
    if stored.crop_mm:
        kept = ", ".join(f"{axis} from {low:g} to {high:g} mm" for axis, (low, high) in stored.crop_mm.items())
        parts.append(f"cropped to {kept}")
    return "; ".join(parts)


def _grid(shape: Sequence[int], spacing: Sequence[float]) -> str:
    voxels, steps = " x ".join(map(str, shape)), " x ".join(f"{step:.4g}" for step in spacing)
    return f"{voxels} voxels of {steps} mm"


def print_planes(options: LabellingOptions, labelled: Sequence[tuple[LabelVolume, FoundPlane]]) -> None:
    """Print a table of the planes, and the next steps to check them."""
    from armscan.anatomy import PIXEL_TISSUES, SUCCESS_THRESHOLD
    from armscan.volumes.markups import MARKUP_SUFFIX

    headings = ("score", "clusters", "rz, rx\n°", "tx, ty\nmm", "equally good\nrz, rx °, along mm")
    rows = []
    for _, plane in labelled:
        rz, rx, tx, ty = plane.action.to_array()
        spread = MISSING if plane.spread is None else ", ".join(f"{each:.0f}" for each in plane.spread)
        rows.append(
            [
                f"{plane.score:.3f}",
                ", ".join(map(str, plane.counts)),
                f"{rz:.1f}, {rx:.1f}",
                f"{tx:.1f}, {ty:.1f}",
                f"≥ {spread}" if plane.is_cut else spread,
            ]
        )
    print_sentence(f"planes written into the manifest of {options.data}")
    names = [volume.name for volume, _ in labelled]
    print_table("volume", names, [Column(heading, justify="right") for heading in headings], rows)
    for volume, plane in labelled:
        for note in _coarse_note(volume) if options.tissues is PIXEL_TISSUES else ():
            print_sentence(f"note: {volume.name}: {note}")
        if (before := volume.optimal_action) is not None:
            rz, rx, tx, ty = before.to_array()
            print_sentence(
                f"note: {volume.name} had the plane rotation: [{rz:g}, {rx:g}], translation: [{tx:g}, {ty:g}]"
            )
        if plane.score <= -SUCCESS_THRESHOLD:
            wanted = f"an environment requires more than {-SUCCESS_THRESHOLD:g}"
            print_sentence(f"note: {volume.name} scores {plane.score:.3f}, and {wanted}")
    print(f"look at   {options.pictures}")
    print("accept    do nothing")
    print("reject    in the manifest, remove rotation, translation, score and found_by from the")
    print("          volume's entry, or give the entry an exclude: REASON")
    if not options.markups:
        print("          (--markups writes the planes as files for 3D Slicer)")
    arguments = ("data", "label", str(options.data), "--volume", "NAME", "--markup", f"FILE{MARKUP_SUFFIX}")
    print("correct   move the plane in 3D Slicer, save it, and read it back:")
    print(f"          {armscan_command(*arguments)}")
    print(f"check     {armscan_command('data', 'inspect', str(options.data))}")

"""The command `python -m armscan.data`: what is in a folder of volumes.

    python -m armscan.data FOLDER

reads the folder's labelmaps as its manifest says (docs/manifest.md), or as an empty manifest would, and prints for each
which tissues it holds, what they are in the file, and what is missing or ignored.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from armscan.errors import InvalidValueError
from armscan.volumes import LABEL_NAMES, Dataset, open_dataset
from armscan.volumes.labelmap import shown
from armscan.volumes.report import VolumeReport
from armscan.words import answered


def main(words: Sequence[str] | None = None) -> int:
    """Prints what the volumes of a folder hold, read as its manifest says; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="nothing was written")


def _run(words: Sequence[str]) -> int:
    if len(words) != 1 or not words[0]:
        raise InvalidValueError(f"the words are {list(words)}, but they must be one folder (--help explains)")
    print_dataset(open_dataset(words[0], require_manifest=False), Console())
    return 0


def print_dataset(dataset: Dataset, console: Console) -> None:
    """Prints a table for each volume, and what was left out."""
    for name, report in dataset.reports.items():
        plane = "a labelled plane" if dataset.volumes[name].optimal_action else "no labelled plane"
        split = f"for {dataset.splits[name]}, " if dataset.splits else ""
        console.print(Text(f"{name}: subject {dataset.subjects[name]}, {split}{plane}", style="bold"), soft_wrap=True)
        console.print(Text(_geometry(report)), soft_wrap=True)
        console.print(report_table(report))
    for name, reason in dataset.excluded.items():
        console.print(Text(f"{name}: excluded" + ("" if reason == "True" else f" ({reason})")), soft_wrap=True)


def report_table(report: VolumeReport) -> Table:
    """Returns a row for each tissue: what it is in the file, and how much of it the volume holds."""
    table = Table()
    for heading in ("tissue", "in the file (voxels)"):
        table.add_column(heading)
    for heading in ("voxels", "mm3"):
        table.add_column(heading, justify="right")
    for label, tissue in LABEL_NAMES.items():
        sources = ", ".join(f"{each.source} ({each.n_voxels})" for each in report.stored.found if each.label == label)
        figures = (
            (str(report.n_voxels[tissue]), f"{report.tissue_mm3[tissue]:.0f}")
            if tissue in report.n_voxels
            else ("", "")
        )
        table.add_row(tissue, Text(sources or "-"), *figures)
    if report.stored.missing:
        table.add_row("not there", Text(shown(report.stored.missing)), "", "")
    return table


def _geometry(report: VolumeReport) -> str:
    stored = report.stored
    parts = [f"{_grid(report.shape, report.spacing)}, axes towards {report.orientation}"]
    is_as_stored = (report.shape, report.spacing, report.orientation) == (
        stored.shape,
        stored.spacing,
        stored.orientation,
    )
    if not is_as_stored:
        parts.append(f"read from {_grid(stored.shape, stored.spacing)}, axes towards {stored.orientation}")
    if stored.crop_mm:
        kept = ", ".join(f"{axis} from {low:g} to {high:g} mm" for axis, (low, high) in stored.crop_mm.items())
        parts.append(f"cropped to {kept}")
    return "; ".join(parts)


def _grid(shape: Sequence[int], spacing: Sequence[float]) -> str:
    voxels, steps = " x ".join(map(str, shape)), " x ".join(f"{step:.4g}" for step in spacing)
    return f"{voxels} voxels of {steps} mm"


if __name__ == "__main__":
    sys.exit(main())

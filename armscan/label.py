"""The command `python -m armscan.label`: optimal planes for volumes that have none, for a person to accept or reject.

    python -m armscan.label data=FOLDER                             label the volumes of the folder that have no plane
    python -m armscan.label data=FOLDER markup=FILE volume=NAME     take a plane that was moved or drawn in 3D Slicer

data=FOLDER         the volumes, and the manifest that the planes are written into (made where there is none)
clustering=metric   cluster what is seen by millimetres, for volumes of another spacing than about 0.27 x 0.55 mm
volumes=[A,B]       only these, by their file names
overwrite=true      volumes that have a plane as well
pictures=FOLDER     where pictures go, FOLDER/labelling of the data where nothing is said
markups=true        a markups file (.mrk.json) for 3D Slicer beside each picture, and for volumes that have a plane
markup=FILE         read the plane from this markups file ...
volume=NAME         ... for this volume, whether it has a plane or not
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from armscan.anatomy import checked_tissues
from armscan.checks import check_bool
from armscan.errors import InvalidValueError
from armscan.labelling import DELTA, Labelled, Request, label
from armscan.volumes.markups import MARKUP_SUFFIX
from armscan.words import answered, read_words

# Within the folder of the data, where no other is asked for.
PICTURES = "labelling"
# Keys whose values are taken as they are written, whatever a path looks like; lists and truth values are parsed.
TEXTS = ("data", "clustering", "pictures", "markup", "volume")


def parse(words: Sequence[str]) -> Request:
    """Returns what `key=value` words ask for.

    Raises:
        InvalidValueError: if a word is something else, a key unknown, or a value of another kind.
    """
    allowed = ["clustering" if field.name == "tissues" else field.name for field in fields(Request)]
    values = read_words(words, allowed, TEXTS)
    if "data" not in values:
        raise InvalidValueError("data is not set, but it must be: give data=FOLDER (--help explains)")
    if ("markup" in values) != ("volume" in values):
        raise InvalidValueError("markup and volume must be given together: which file, and for which volume")
    if idle := [key for key in ("volumes", "overwrite") if key in values and "markup" in values]:
        raise InvalidValueError(f"{idle[0]} is for a search, but markup and volume say which plane and for what")
    data = Path(values["data"])
    return Request(
        data=data,
        tissues=checked_tissues(values.get("clustering", "pixels")),
        volumes=_names(values["volumes"]) if "volumes" in values else None,
        overwrite=check_bool("overwrite", values.get("overwrite", False)),
        pictures=Path(values["pictures"]) if "pictures" in values else data / PICTURES,
        markups=check_bool("markups", values.get("markups", False)),
        markup=Path(values["markup"]) if "markup" in values else None,
        volume=values.get("volume"),
    )


def _names(value: Any) -> tuple[str, ...]:
    names = value if isinstance(value, list) else [value]
    if not names or not all(isinstance(name, str) for name in names):
        raise InvalidValueError(f"volumes is {value!r}, but it must be the names of some volumes: [A,B]")
    return tuple(names)


def print_report(request: Request, labelled: Sequence[Labelled]) -> None:
    """Prints a table of the planes, and what the person who looks at them can do next."""
    table = Table(title="planes written into the manifest", title_justify="left")
    table.add_column("volume", overflow="fold")
    for heading in ("score", "clusters", "rz, rx\n°", "tx, ty\nmm", "as good over\n°, °, mm"):
        table.add_column(heading, justify="right")
    for plane in labelled:
        rz, rx, tx, ty = plane.action.to_array()
        table.add_row(
            Text(plane.volume.name),
            f"{plane.score:.3f}",
            ", ".join(map(str, plane.counts)),
            f"{rz:.1f}, {rx:.1f}",
            f"{tx:.1f}, {ty:.1f}",
            "-" if plane.spread is None else "{:.0f}, {:.0f}, {:.0f}".format(*plane.spread),
        )
    Console().print(table)
    for plane in labelled:
        if plane.score <= -DELTA:
            print(f"note: {plane.volume.name} scores {plane.score:.3f}, and an environment wants more than {-DELTA:g}")
    folder = request.pictures
    print(f"look at   {folder}")
    print("accept    nothing is left to do")
    print(
        "reject    take rotation, translation and score out of the volume's entry, or give the entry an exclude: REASON"
    )
    if not request.markups:
        print("          (markups=true writes the planes as files for 3D Slicer)")
    print("correct   move the plane in 3D Slicer, save it, and read it back:")
    print(f"          python -m armscan.label data={request.data} volume=NAME markup=FILE{MARKUP_SUFFIX}")


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="the planes found so far are in the manifest")


def _run(words: Sequence[str]) -> int:
    request = parse(words)
    labelled, failures = label(request)
    if labelled:
        print_report(request, labelled)
    elif not failures:
        print("every volume has a plane already; overwrite=true looks for new ones")
        if request.markups:
            print(f"their planes as files for 3D Slicer are in {request.pictures}")
    for failure in failures:
        print(f"error: {failure}", file=sys.stderr)
    return 2 if failures else 0


if __name__ == "__main__":
    sys.exit(main())

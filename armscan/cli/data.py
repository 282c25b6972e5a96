"""`armscan data`: inspect a folder of volumes, label its planes, explore its slices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from armscan.cli.data_tables import PICTURES, print_dataset, print_planes
from armscan.cli.options import (
    FILE_PATH,
    CommaSeparated,
    clustering_option,
    examples,
    is_given,
    tracking_option,
    trust_option,
)
from armscan.errors import InvalidValueError, print_error

if TYPE_CHECKING:
    from armscan.evaluation.agent_search import AgentSearch


@click.group()
def data() -> None:
    """Inspect, label and explore volumes."""


@data.command(epilog=examples("data inspect wrists"))
@click.argument("folder", type=FILE_PATH)
def inspect(folder: Path) -> None:
    """Print the contents of the volumes in FOLDER.

    Volumes are read through the manifest, if there is one; their tissues, and what is missing or ignored, are listed.
    docs/manifest.md describes the manifest.
    """
    # Deferred: `--help` needs none of it.
    from armscan.volumes import open_dataset

    print_dataset(open_dataset(folder, require_manifest=False), folder)


@data.command(epilog=examples("data label wrists", "data label wrists --volume a.nii.gz --markup moved.mrk.json"))
@click.argument("folder", type=FILE_PATH)
@click.option("--volumes", type=CommaSeparated("NAME"), help="Only these volumes, by their file names.")
@click.option("--overwrite", is_flag=True, help="Also label volumes that have a plane.")
@click.option(
    "--pictures",
    type=FILE_PATH,
    metavar="FOLDER",
    show_default=f"FOLDER/{PICTURES}",
    help="Folder of the pictures of the planes.",
)
@click.option("--markups", is_flag=True, help="Write each plane as a markups file (.mrk.json) for 3D Slicer, too.")
@click.option("--markup", type=FILE_PATH, metavar="FILE", help="Read the plane of --volume from this markups file.")
@click.option("--volume", metavar="NAME", help="Volume of --markup.")
@click.option("--agent", metavar="RUN", help="Let the agent of this run find the planes, instead of the search.")
@clustering_option
@tracking_option(help="MLflow tracking store of --agent.")
@trust_option
def label(
    folder: Path,
    volumes: tuple[str, ...] | None,
    overwrite: bool,
    pictures: Path | None,
    markups: bool,
    markup: Path | None,
    volume: str | None,
    agent: str | None,
    clustering: str | None,
    tracking: str,
    trust: bool,
) -> int:
    """Find a plane for each volume in FOLDER.

    Volumes that have a plane are left alone by default. The planes, for a person to accept or reject, are written into
    the manifest, which is created if there is none. docs/labelling.md explains how to check and correct them.
    """
    if (markup is None) != (volume is None):
        raise click.UsageError("--markup and --volume must be given together: which file, and for which volume")
    if markup is not None and (volumes or overwrite or agent):
        idle = "--volumes" if volumes else "--overwrite" if overwrite else "--agent"
        raise click.UsageError(
            f"{idle} cannot be combined with --markup and --volume, which read the plane of one volume from a file"
        )
    if pictures is None and (folder / PICTURES).is_symlink():
        # Otherwise the author of the data folder would choose where pictures are written.
        raise InvalidValueError(f"{folder / PICTURES}: is a link: name the folder of the pictures with --pictures")
    if agent is None and (is_given("tracking") or trust):
        raise click.UsageError("--tracking and --trust are for --agent")
    from armscan.anatomy import check_tissues
    from armscan.annotation.labelling import LabellingOptions
    from armscan.annotation.labelling import label as label_planes

    search = None if agent is None else _agent_search(agent, tracking, clustering, trust=trust)
    options = LabellingOptions(
        data=folder,
        tissues=check_tissues(clustering or "pixels") if search is None else search.tissues,
        volumes=volumes,
        overwrite=overwrite,
        pictures=pictures or folder / PICTURES,
        markups=markups,
        markup=markup,
        volume=volume,
        search=search,
        found_by=None if search is None else search.run_id,
    )
    labelled, failures = label_planes(options)
    if labelled:
        print_planes(options, labelled)
    elif not failures:
        print(f"every volume{' named' if volumes else ''} has a plane already; --overwrite looks for new ones")
        if markups:
            print(f"their planes as files for 3D Slicer are in {options.pictures}")
    for failure in failures:
        print_error(str(failure))
    return 2 if failures else 0


def _agent_search(run: str, tracking: str, clustering: str | None, *, trust: bool) -> AgentSearch:
    from armscan.evaluation import agent_of_run
    from armscan.evaluation.agent_search import AgentSearch

    changes = {} if clustering is None else {"clustering": clustering}
    return AgentSearch(agent_of_run(tracking, run, changes, trust=trust))


@data.command(epilog=examples("data explore wrists --volume a.nii.gz"))
@click.argument("folder", type=FILE_PATH, required=False)
@click.option("--volume", metavar="NAME", help="Volume to begin with.  [default: the first]")
@clustering_option
def explore(folder: Path | None, volume: str | None, clustering: str | None) -> None:
    """Move the plane with sliders in a window.

    FOLDER holds the volumes, with a manifest or without. Default: phantom wrists.

    In a notebook: %matplotlib widget, then armscan.annotation.explorer.explore(volume).
    """
    from armscan.envs.window import check_display

    # Before pyplot: it raises for a backend of MPLBACKEND that does not exist.
    check_display()
    from matplotlib import pyplot

    from armscan.annotation.explorer import explore as open_explorer

    open_explorer(folder, volume=volume, clustering=clustering or "pixels")
    pyplot.show()

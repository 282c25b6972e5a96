"""`armscan runs`: the runs of an MLflow tracking store."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armscan.cli.options import (
    FILE_PATH,
    CommaSeparated,
    Moment,
    UriParam,
    examples,
    storage_option,
    tracking_option,
    trust_option,
)
from armscan.config.command_hints import armscan_command
from armscan.config.defaults import default_tracking
from armscan.config.trust import check_stored_address
from armscan.errors import TrackingError, printable
from armscan.utils.processes import limit_threads
from armscan.utils.text import counted

if TYPE_CHECKING:
    from armscan.tracking import TrackingStore

STATUSES = ("finished", "failed", "killed", "running")
SORTS = ("started", "duration", "plane", "success", "steps", "size")
REPRODUCTIONS = Path("reproductions")
SELECTION = (
    click.option("--experiment", metavar="NAME", help="Only runs of this MLflow experiment."),
    click.option(
        "--status",
        type=CommaSeparated("STATUS", STATUSES),
        help=f"Only runs with one of these statuses: {', '.join(STATUSES)}.",
    ),
    click.option("--agent", type=CommaSeparated("NAME"), help="Only runs of these agents."),
    click.option("--obs", type=CommaSeparated("NAME"), help="Only runs with these observations."),
    click.option("--projection", metavar="NAME,...", help="Only runs with these projections, such as zy or [rz,ty]."),
    click.option("--since", type=Moment(), help="Only runs started then or later: 90m, 12h, 7d, 4w or 2026-01-31."),
    click.option("--before", type=Moment(), help="Only runs started before then."),
    click.option("--where", metavar="FILTER", help="Only runs that match this MLflow filter string."),
    click.option("--parent", metavar="RUN", help="Only runs below this grid, study or evaluated run."),
    click.option(
        "--sort",
        type=click.Choice([f"{sign}{key}" for key in SORTS for sign in ("", "-")]),
        metavar="KEY",
        default="-started",
        help=f"Sort by {', '.join(SORTS)}; -KEY sorts in descending order. plane: on-plane rate.",
    ),
    click.option("--limit", type=click.IntRange(1), help="Maximum number of runs."),
)


def _with_selection(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that select runs."""
    for option in reversed(SELECTION):
        command = option(command)
    return command


@click.group()
def runs() -> None:
    """List, show, stop, prune, sync and reproduce runs."""


@runs.command(
    "list",
    epilog=examples("runs list --status failed,killed --since 7d", "runs list --agent sac --sort -plane --limit 5"),
)
@_with_selection
@click.option("--format", "form", type=click.Choice(["table", "csv", "json"]), default="table", help="Output format.")
@click.option("--children", is_flag=True, help="List children below their parents, not collapsed into them.")
@tracking_option()
def list_runs(form: str, children: bool, tracking: str, sort: str, limit: int | None, **selected: Any) -> None:
    """List runs, the newest first.

    docs/runs.md explains the columns.
    """
    from armscan.runs.query import find_runs
    from armscan.runs.rows import collapse, sort_rows
    from armscan.runs.tables import write_rows

    with _open(tracking) as store:
        rows = sort_rows(collapse(store, find_runs(store, **selected)), sort, limit)
        if not rows and form == "table":
            print(f"no run of {store.uri} is selected")
        else:
            write_rows([each for row in rows for each in row.expanded()] if children else rows, form)


@runs.command(epilog=examples("runs show 3bf2"))
@click.argument("run")
@tracking_option()
def show(run: str, tracking: str) -> None:
    """Show everything about a run.

    RUN is an MLflow run ID or its first characters.
    """
    from armscan.runs.show import show as show_run
    from armscan.tracking import find_run

    with _open(tracking) as store:
        show_run(store, find_run(store, run), tracking)


@runs.command(
    epilog=examples("runs prune checkpoints --before 30d", "runs prune folders --status failed --before 7d --apply"),
)
@click.argument("what", type=click.Choice(["checkpoints", "folders"]))
@_with_selection
@click.option("--apply", is_flag=True, help="Remove; without it, nothing is removed.")
@tracking_option()
def prune(what: str, apply: bool, tracking: str, sort: str, limit: int | None, **selected: Any) -> int:
    """Remove checkpoints or folders of ended runs.

    checkpoints: those in the runs' folders; of a failed or killed run, the only copies. folders: all files of the runs
    on this machine. The store does not change: delete runs and artifacts with MLflow. docs/runs.md says what is never
    removed.
    """
    from rich.filesize import decimal

    from armscan.runs.prune import CHECKPOINTS, plan, remove_planned
    from armscan.runs.query import find_runs
    from armscan.runs.rows import RunRow, sort_rows
    from armscan.runs.tables import print_prune_plan

    with _open(tracking) as store:
        rows = [RunRow(store, run) for run in find_runs(store, **selected)]
        items = plan(store, [row.run for row in sort_rows(rows, sort, limit)], what)
        if apply:
            return remove_planned(store, items, what)
        print_prune_plan(items)
    taken = [item for item in items if item.left is None]
    freed = decimal(sum(item.n_bytes for item in taken))
    print(f"{what} of {len(taken)} of {len(items)} runs would be removed, {freed}; nothing was removed")
    if unfinished := [item for item in taken if what == CHECKPOINTS and item.run.info.status != "FINISHED"]:
        print(f"note: {counted(len(unfinished), 'run')} did not finish: these checkpoints may be the only copies")
    if taken:
        print(f"remove it {armscan_command(*click.get_current_context().obj, '--apply')}")
    return 0


@runs.command(epilog=examples("runs stop sac_y", "runs stop 3bf2"))
@click.argument("target", metavar="RUN|STUDY")
@storage_option(help="Optuna storage of the study.")
@tracking_option()
def stop(target: str, storage: str, tracking: str) -> None:
    """Stop a trial, a study, or a run of this machine.

    STUDY is the name of a study: its trials are requeued within ten seconds and an epoch, and the
    command that started it resumes it.
    RUN is an MLflow run ID or its first characters. A trial ends likewise, as pruned, and counts as finished; a run
    outside a study is interrupted as by Ctrl-C.
    """
    from armscan.runs.stop import interrupt, target_of
    from armscan.sweeps.stop import check_tracked, is_study, stop_study, stop_trial
    from armscan.sweeps.storage.storage import existing_storage
    from armscan.tracking import find_run

    if is_study(existing_storage(storage, where="--storage"), target):
        print(stop_study(storage, target))
        return
    with _open(tracking) as store:
        try:
            run = find_run(store, target)
        except TrackingError as error:
            raise TrackingError(f"{error}; and {storage} has no study {target!r}") from error
    if (found := target_of(run)) is None:
        print(interrupt(run))
        return
    check_tracked(storage, found.study, found.trial, runs=found.runs, stored_in=found.storage)
    if found.trial is None:
        print(stop_study(storage, found.study))
    else:
        print(stop_trial(storage, found.study, found.trial))


@runs.command(epilog=examples("runs sync outputs", "runs sync studies/sac_y"))
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--tracking", type=UriParam(), help="MLflow tracking store.  [default: the one that each run names]")
@trust_option
def sync(folder: Path, tracking: str | None, trust: bool) -> int:
    """Upload what runs have not uploaded yet.

    FOLDER is the folder of a run, of a study, or above them. Nothing is uploaded twice, and running runs upload
    by themselves. Exit code: 1 if something is left.
    """
    from armscan.tracking import open_existing_store
    from armscan.tracking import sync as upload_left
    from armscan.tracking.pending_runs import pending_runs
    from armscan.tracking.store import absolute

    own = {absolute(default_tracking()["uri"]), *(each.uri for each in pending_runs().values())}

    def opened(tracked_in: str) -> TrackingStore:
        if tracking is None and not trust:
            check_stored_address(tracked_in, own)
        return open_existing_store(tracking or tracked_in)

    uploads = upload_left(folder, cache(opened), trust=trust)
    for each in uploads:
        which = f"run {each.run_id}" if each.run_id else "a run"
        left = f", the rest is left: {each.left}" if each.left else ""
        print(printable(f"{which} in {each.folder}: {each.n_entries} entries uploaded{left}"))
    if not uploads:
        print(f"{folder}: nothing left to upload")
    return 1 if any(each.left for each in uploads) else 0


@runs.command(epilog=examples("runs reproduce 3bf2 --dry-run", "runs reproduce 3bf2 --out again"))
@click.argument("run")
@click.option("--dry-run", is_flag=True, help="Only list what differs from the run.")
@click.option(
    "--out", type=FILE_PATH, metavar="FOLDER", show_default="reproductions/ID-TIME", help="Folder of the new run."
)
@tracking_option()
@trust_option
def reproduce(run: str, dry_run: bool, out: Path | None, tracking: str, trust: bool) -> int:
    """Repeat a run, and compare every metric.

    RUN is an MLflow run ID or its first characters. Nothing is checked out or installed: differences in
    code, packages and machine are listed. The volumes must be the same. The new run has the configuration and the seed
    of the old one, and is tracked beside it. Exit code: 0 if all metrics are equal (with --dry-run: if nothing
    differs), else 1.
    """
    # As in `armscan run`.
    limit_threads()
    from armscan.runs import reproduce as reproduction
    from armscan.utils.run_files import ID_CHARS

    original = reproduction.load_original(tracking, run, trust=trust)
    differences = reproduction.differences(original)
    print(f"run {original.run.run_id}: {printable(original.run.name)}")
    for difference in differences:
        print(printable(f"differs: {difference}"))
    for part in (unknown := reproduction.not_compared(original)):
        print(f"not compared: {part}")
    if not differences:
        print(f"{'' if unknown else 'code, '}packages, machine and volumes are unchanged")
    if dry_run:
        return 1 if differences else 0
    folder = out or REPRODUCTIONS / f"{original.run.run_id[:ID_CHARS]}-{datetime.now():%Y-%m-%d_%H-%M-%S}"
    comparison = reproduction.reproduce(original, folder, differences)
    print(*map(printable, comparison.lines()), sep="\n")
    return 0 if comparison.is_same else 1


@contextmanager
def _open(uri: str) -> Iterator[TrackingStore]:
    """Open a store; turn its errors into a `TrackingError`."""
    from armscan.tracking import open_existing_store
    from armscan.tracking.store import store_errors

    store = open_existing_store(uri)
    with store_errors(store.uri):
        yield store

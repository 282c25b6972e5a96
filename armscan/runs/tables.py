"""Runs as a table for a terminal, and as CSV and JSON for a script."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from mlflow.entities import Run
from rich.filesize import decimal
from rich.table import Column
from rich.text import Text

from armscan.errors import printable
from armscan.runs.prune import PruneItem
from armscan.runs.query import projection_of
from armscan.runs.rows import RunRow
from armscan.stats.on_plane import ON_PLANE
from armscan.tracking.tags import AGENT_TAG, BEST_TAG, FOLDER_TAG, HOST_TAG, OBS_TAG, PARENT_TAG
from armscan.utils.console import print_table, wide_console
from armscan.utils.csv_file import write_csv
from armscan.utils.run_files import ID_CHARS
from armscan.utils.text import MISSING, PERCENT, format_duration, formatted

# Longest name to show; that of a grid is its command line.
MAX_NAME_CHARS = 80


def format_start(run: Run) -> str:
    """Return when a run was started: the day, or the time if it was today."""
    moment = datetime.fromtimestamp(run.info.start_time / 1000).astimezone()
    is_today = moment.date() == datetime.now().astimezone().date()
    return f"{moment:%H:%M}" if is_today else f"{moment:%Y-%m-%d}"


def write_rows(rows: Sequence[RunRow], form: str) -> None:
    """Print runs, in the order of their rows, as `table`, `csv` or `json`."""
    if form == "table":
        _print_table(rows)
        return
    values = [_values(row) for row in rows]
    if form == "json":
        print(json.dumps(values, indent=1))
        return
    write_csv(sys.stdout, COLUMNS, values)


def _print_table(rows: Sequence[RunRow]) -> None:
    """Print runs as a table; where names do not fit, each stands in a line above its run."""
    limits = {row.on_plane for row in rows if row.on_plane_rate is not None} or {ON_PLANE[0]}
    # A heading of several lines keeps the column narrow.
    plane = "on\nplane" + (",\n{:g} mm\n{:g}°".format(*min(limits)) if len(limits) == 1 else "")
    right = [Column(name, justify="right") for name in ("took", plane, "success", "steps,\nmean", "size", "below")]
    cells = []
    for row in rows:
        on_plane, success, steps = row.on_plane_rate, row.success_rate, row.mean_steps
        size = decimal(row.n_bytes) + ("" if row.artifact_bytes is not None else "+?")
        best = "best " if BEST_TAG in row.run.data.tags else ""
        within = "" if len(limits) == 1 else " ({:g} mm {:g}°)".format(*row.on_plane)
        cells.append(
            [
                row.run.info.run_id[:ID_CHARS],
                row.run.info.status.lower(),
                format_start(row.run),
                format_duration(row.duration_s),
                MISSING if on_plane is None else f"{best}{formatted(PERCENT, on_plane)}{within}",
                MISSING if success is None else formatted(PERCENT, success),
                MISSING if steps is None else f"{steps:.1f}",
                size,
                str(len(row.below) or ""),
            ]
        )
    names = ["  " * row.depth + shortened(row.run.info.run_name) for row in rows]
    print_table("name", names, [*map(Column, ("id", "status", "started")), *right], cells)


def shortened(name: str) -> str:
    """Return a name that is safe to show, and not too long for a line of a list."""
    name = printable(name)
    return name if len(name) <= MAX_NAME_CHARS else f"{name[: MAX_NAME_CHARS - 1]}…"


COLUMNS = (
    *("run_id", "name", "status", "experiment_id", "parent", "started", "duration_s"),
    *("on_plane_rate", "on_plane_mm", "on_plane_deg", "success_rate", "mean_steps"),
    *("size_bytes", "folder_bytes", "artifact_bytes", "below"),
    *("agent", "obs", "projection", "folder", "host", "best_run"),
)


def _values(row: RunRow) -> dict[str, Any]:
    info, tags = row.run.info, row.run.data.tags
    values = (
        *(info.run_id, info.run_name, info.status, info.experiment_id, tags.get(PARENT_TAG)),
        *(row.started.isoformat(timespec="seconds"), row.duration_s),
        *(row.on_plane_rate, *row.on_plane, row.success_rate, row.mean_steps),
        *(row.n_bytes, row.folder_bytes, row.artifact_bytes, len(row.below)),
        *(tags.get(AGENT_TAG), tags.get(OBS_TAG), projection_of(row.run)),
        *(tags.get(FOLDER_TAG), tags.get(HOST_TAG), tags.get(BEST_TAG)),
    )
    return dict(zip(COLUMNS, values, strict=True))


def print_prune_plan(items: Sequence[PruneItem]) -> None:
    """Print the files that would be removed, and why the others would stay."""
    for item in items:
        info = item.run.info
        named = f"{shortened(info.run_name)}, {info.status.lower()}, of {format_start(item.run)}"
        what = f"frees {decimal(item.n_bytes)}: {named}" if item.left is None else f"stays: {item.left}"
        wide_console().print(Text(f"{info.run_id[:ID_CHARS]} {what}"), soft_wrap=True)

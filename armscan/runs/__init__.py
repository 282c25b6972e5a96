"""The runs of a tracking store: list, show, prune."""

from armscan.runs.disk_usage import Sizes
from armscan.runs.prune import NotRemovedError, gc_hint, remove
from armscan.runs.prune_plan import RUNS, WHAT, plan
from armscan.runs.query import Selection, find
from armscan.runs.rows import collapse, expand, sort_rows
from armscan.runs.run_folder import RunSkippedError
from armscan.runs.show import show
from armscan.runs.tables import format_bytes, print_plan, write_entries

__all__ = [
    "RUNS",
    "WHAT",
    "NotRemovedError",
    "RunSkippedError",
    "Selection",
    "Sizes",
    "collapse",
    "expand",
    "find",
    "format_bytes",
    "gc_hint",
    "plan",
    "print_plan",
    "remove",
    "show",
    "sort_rows",
    "write_entries",
]

"""The runs of a tracking store: list, show, prune."""

from armscan.runs.prune import plan, remove
from armscan.runs.query import Selection, find
from armscan.runs.rows import RunRow, collapse, expand, sort_rows
from armscan.runs.run_folder import RunSkippedError
from armscan.runs.show import show
from armscan.runs.tables import print_plan, write_entries

__all__ = [
    "RunRow",
    "RunSkippedError",
    "Selection",
    "collapse",
    "expand",
    "find",
    "plan",
    "print_plan",
    "remove",
    "show",
    "sort_rows",
    "write_entries",
]

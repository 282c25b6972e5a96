"""The runs of a store: listed, shown, and removed where nobody needs them any more."""

from armscan.inventory.entries import folded, ordered, unfolded
from armscan.inventory.plan import RUNS, WHAT, half_removed, plan
from armscan.inventory.removal import LeftError, NotRemovedError, remove
from armscan.inventory.selection import find, read_selection
from armscan.inventory.showing import show
from armscan.inventory.sizes import Sizes
from armscan.inventory.tables import FORMATS, print_plan, readable, write_entries

__all__ = [
    "FORMATS",
    "RUNS",
    "WHAT",
    "LeftError",
    "NotRemovedError",
    "Sizes",
    "find",
    "folded",
    "half_removed",
    "ordered",
    "plan",
    "print_plan",
    "read_selection",
    "readable",
    "remove",
    "show",
    "unfolded",
    "write_entries",
]

"""Compare runs by their IDs."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

from armscan.reports.select import EXPERIMENT, find_trainings, read_runs
from armscan.tracking import open_existing_store
from armscan.utils.files import sha256
from armscan.utils.run_files import ID_CHARS
from armscan.utils.text import counted

REPORTS = Path("reports")
# A longer folder name is replaced by its hash.
MAX_NAME_CHARS, SUM_CHARS = 60, 12


def write_runs_report(text: str, uri: str, out: Path | None) -> Path:
    """Write a report that compares runs.

    Args:
        text: Names of the runs; see `read_runs`.
        uri: Address of their store.
        out: Folder for the report; None: a folder in `reports`, named after the runs.

    Returns:
        The HTML file.

    Raises:
        InvalidValueError: If one of the names is empty, or the report would replace files that are not a report's.
        TrackingError: If one of them is not found, cannot be compared, or has a damaged file.
    """
    named = read_runs(text)
    store = open_existing_store(uri)
    found = find_trainings(store, named)
    # Deferred: missing runs are reported before these are loaded.
    from armscan.reports.comparison import write_comparison
    from armscan.reports.groups import group_trainings
    from armscan.reports.load import read_trainings

    print(f"reading   {counted(len(found), 'run')}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        trainings = read_trainings(store, found, Path(folder))
    groups, left_out = group_trainings(trainings)
    n_runs = counted(len(trainings), "run")
    experiments = [name.removeprefix(EXPERIMENT) for name in named if name.startswith(EXPERIMENT)]
    title = f"{n_runs} of {', '.join(experiments)}" if len(experiments) == len(named) else n_runs
    return write_comparison(groups, left_out, title, out or REPORTS / _folder_name(named))


def _folder_name(named: Sequence[str]) -> str:
    labels = [name.removeprefix(EXPERIMENT) if name.startswith(EXPERIMENT) else name[:ID_CHARS] for name in named]
    name = re.sub(r"[^\w.\-]+", "-", "-".join(["runs", *labels]))
    return name if len(name) <= MAX_NAME_CHARS else f"runs-{sha256(name.encode())[:SUM_CHARS]}"

"""Row of a list: a run with its figures, and the runs collapsed into it."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property

from mlflow.entities import Run
from mlflow.exceptions import MlflowException
from requests import RequestException

from armscan.errors import UntrustedError
from armscan.runs.run_folder import OwnFolder, RunSkippedError
from armscan.stats.on_plane import OnPlane, leading_of
from armscan.tracking import TrackingStore
from armscan.tracking.outbox import ENDED
from armscan.tracking.run import MAX_DEPTH
from armscan.tracking.tags import PARENT_TAG, TEST_VOLUMES_PREFIX

# Attributes of a row by sort key.
SORTS = {
    "started": "started",
    "duration": "duration_s",
    "plane": "on_plane_rate",
    "success": "success_rate",
    "steps": "mean_steps",
    "size": "n_bytes",
}


def artifacts_of(store: TrackingStore, run: Run) -> dict[str, int] | None:
    """Return the bytes of each artifact of a run by its path; None if their store cannot be read."""

    def listed(path: str | None) -> Iterator[tuple[str, int]]:
        for each in repository.list_artifacts(path):
            if each.is_dir:
                yield from listed(each.path)
            else:
                yield each.path, each.file_size or 0

    try:
        repository = store.artifacts(run)
        return dict(listed(None))
    # The run is listed all the same, with an unknown size.
    except (MlflowException, RequestException, OSError, UntrustedError):
        return None


@dataclass(frozen=True)
class RunRow:
    """A run of a list.

    Args:
        store: Store of the run, which gives sizes when they are needed.
        run: Run of the row.
        children: Rows of the selected runs that it started, the earliest first. Default: none.
        depth: Level below the topmost run, 0 or more; 1 for a child shown below its parent. Default: 0.
        is_collapsed: Whether its sizes include those of the runs below it. Default: True.
    """

    store: TrackingStore = field(repr=False)
    run: Run
    children: tuple[RunRow, ...] = ()
    depth: int = 0
    is_collapsed: bool = True

    @property
    def below(self) -> list[RunRow]:
        """Rows of its children, and of theirs."""
        return [row for child in self.children for row in (child, *child.below)]

    @cached_property
    def folder_bytes(self) -> int:
        """Bytes of its own files in its folder on this machine, and of those collapsed into it."""
        n_bytes = sum(child.folder_bytes for child in self.children) if self.is_collapsed else 0
        with contextlib.suppress(RunSkippedError):
            n_bytes += sum(OwnFolder.of(self.run).files().values())
        return n_bytes

    @cached_property
    def artifact_bytes(self) -> int | None:
        """Bytes of its artifacts, and of those collapsed into it; None if a store cannot be read."""
        artifacts = artifacts_of(self.store, self.run)
        parts = [None if artifacts is None else sum(artifacts.values())]
        parts += [child.artifact_bytes for child in self.children if self.is_collapsed]
        known = [part for part in parts if part is not None]
        return sum(known) if len(known) == len(parts) else None

    @property
    def n_bytes(self) -> int:
        """All bytes that are known."""
        return self.folder_bytes + (self.artifact_bytes or 0)

    @property
    def started(self) -> datetime:
        """Time of its start, in local time."""
        return datetime.fromtimestamp(self.run.info.start_time / 1000).astimezone()

    @property
    def duration_s(self) -> float | None:
        """Duration in seconds; None if it has not ended."""
        # MLflow keeps the end time of a run that was resumed.
        end = self.run.info.end_time if self.run.info.status in ENDED else None
        return None if end is None else (end - self.run.info.start_time) / 1000

    @property
    def on_plane(self) -> OnPlane:
        """Leading limits of its on-plane rates, from its configuration; the default ones for older runs."""
        return leading_of(self.run.data.params)

    @property
    def on_plane_rate(self) -> float | None:
        """On-plane rate on the test volumes, within its leading limits; None if it was not evaluated."""
        return self._tested(self.on_plane.metric)

    @property
    def success_rate(self) -> float | None:
        """Success rate on the test volumes; None if it was not evaluated."""
        return self._tested("success_rate")

    @property
    def mean_steps(self) -> float | None:
        """Mean steps on the test volumes; None if it was not evaluated."""
        return self._tested("mean_steps")

    def _tested(self, metric: str) -> float | None:
        return self.run.data.metrics.get(f"{TEST_VOLUMES_PREFIX}{metric}")

    def expanded(self, depth: int = 0) -> Iterator[RunRow]:
        """Yield the row and those below it, each below its parent."""
        yield replace(self, depth=depth, is_collapsed=False)
        for child in self.children:
            yield from child.expanded(depth + 1)


def collapse(store: TrackingStore, runs: Sequence[Run]) -> list[RunRow]:
    """Return a row for each run whose parent is not among the runs; the others are collapsed into these rows.

    Runs that are nested too deeply, or are their own ancestors, also have rows of their own.
    """
    parents = {run.info.run_id: run.data.tags.get(PARENT_TAG, "") for run in runs}

    def is_too_deep(run_id: str) -> bool:
        for _ in range(MAX_DEPTH):
            run_id = parents.get(run_id, "")
        return run_id in parents

    children: dict[str, list[Run]] = defaultdict(list)
    for run in sorted(runs, key=lambda run: run.info.start_time):
        run_id = run.info.run_id
        is_below = parents[run_id] in parents and not is_too_deep(run_id)
        children[parents[run_id] if is_below else ""].append(run)

    def rows(parent: str) -> tuple[RunRow, ...]:
        return tuple(RunRow(store, run, rows(run.info.run_id)) for run in children[parent])

    return list(rows(""))


def sort_rows(rows: Sequence[RunRow], sort: str, limit: int | None) -> list[RunRow]:
    """Return rows by one of `SORTS`, the greatest first with - before it; those without a value always come last.

    Args:
        rows: Rows to sort.
        sort: Key of `SORTS`, perhaps with - before it.
        limit: Number of rows to return; None for all.
    """
    # Read once: a size is a request to the server.
    values = [(getattr(row, SORTS[sort.removeprefix("-")]), row) for row in rows]
    known = [each for each in values if each[0] is not None]
    known.sort(key=lambda each: each[0], reverse=sort.startswith("-"))
    return [row for _, row in (*known, *(each for each in values if each[0] is None))][:limit]

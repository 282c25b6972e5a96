"""A line of a list: a run with what is known of it, and the runs that are folded into it."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Self

from mlflow.entities import Run
from mlflow.exceptions import MlflowException
from mlflow.store.artifact.artifact_repository_registry import get_artifact_repository
from requests import RequestException

from armscan.runs.run_folder import OwnFolder, RunSkippedError
from armscan.tracking import TrackingStore
from armscan.tracking.sync import ENDED

PARENT_TAG = "mlflow.parentRunId"
Children = Mapping[str, Sequence[Run]]


@dataclass(frozen=True)
class Size:
    """Bytes on disks.

    Args:
        in_folder: bytes of the runs' own files in their folders on this machine.
        in_store: bytes of their artifacts; None if a store does not tell.
    """

    in_folder: int
    in_store: int | None

    @classmethod
    def of(cls, client: TrackingStore, runs: Sequence[Run]) -> Self:
        """Measure runs of a store."""
        in_folder, in_store = 0, [artifacts_of(client, run) for run in runs]
        for run in runs:
            with contextlib.suppress(RunSkippedError):
                in_folder += sum(OwnFolder.of(run).files().values())
        known = [sum(files.values()) for files in in_store if files is not None]
        return cls(in_folder, sum(known) if len(known) == len(in_store) else None)

    @property
    def n_bytes(self) -> int:
        """All that is known."""
        return self.in_folder + (self.in_store or 0)


def artifacts_of(client: TrackingStore, run: Run) -> dict[str, int] | None:
    """Return the bytes of each artifact of a run by its path; None if their store does not tell."""

    def listed(path: str | None) -> Iterator[tuple[str, int]]:
        for each in repository.list_artifacts(path):
            if each.is_dir:
                yield from listed(each.path)
            else:
                yield each.path, each.file_size or 0

    try:
        repository = get_artifact_repository(run.info.artifact_uri, tracking_uri=client.mlflow.tracking_uri)
        return dict(listed(None))
    # What is there is not lost because nobody can say how much it is.
    except (MlflowException, RequestException, OSError):
        return None


@dataclass(frozen=True)
class RunRow:
    """A run of a list.

    Args:
        client: the run's store, asked for sizes when they are needed.
        run: the run.
        below: the runs that it has called forth, and theirs, as far as they are meant.
        depth: 0 where it stands by itself, 1 for a child that is shown below its parent, and so on.
        is_unfolded: whether those below have lines of their own.
    """

    client: TrackingStore = field(repr=False)
    run: Run
    below: tuple[Run, ...] = ()
    depth: int = 0
    is_unfolded: bool = True

    @cached_property
    def size(self) -> Size:
        """Of the run, and of those that are folded into it."""
        return Size.of(self.client, [self.run, *(() if self.is_unfolded else self.below)])

    @property
    def started(self) -> datetime:
        """When it was started."""
        return started(self.run)

    @property
    def duration_s(self) -> float | None:
        """How long it took; None where it has not ended."""
        # MLflow keeps the end of a run that goes on again.
        end = self.run.info.end_time if self.run.info.status in ENDED else None
        return None if end is None else (end - self.run.info.start_time) / 1000

    @property
    def success_rate(self) -> float | None:
        """On the test volumes; None where it was not judged."""
        return self.run.data.metrics.get("test_volumes/success_rate")

    @property
    def mean_steps(self) -> float | None:
        """Mean steps on the test volumes; None where it was not judged."""
        return self.run.data.metrics.get("test_volumes/mean_steps")

    def value_of(self, sort: str) -> float | None:
        """Return what it is sorted by, `started`, `duration`, `success`, `steps` or `size`; None where it has none."""
        if sort == "size":
            # A server is asked for each run's size.
            return self.size.n_bytes
        values = {"duration": self.duration_s, "success": self.success_rate, "steps": self.mean_steps}
        return values.get(sort, self.started.timestamp())


def started(run: Run) -> datetime:
    """Return when a run was started, in local time."""
    return datetime.fromtimestamp(run.info.start_time / 1000).astimezone()


def collapse(client: TrackingStore, runs: Sequence[Run]) -> list[RunRow]:
    """Return runs without those whose parent is among them, which are folded into it."""
    children, tops = _family(runs)
    return [RunRow(client, run, tuple(_beneath(run, children)), is_unfolded=False) for run in tops]


def expand(entries: Sequence[RunRow], runs: Sequence[Run]) -> list[RunRow]:
    """Return entries with those below them, each below its parent, the earliest first.

    Args:
        entries: as `collapse` returns them, in any order.
        runs: the runs that they were folded from.
    """
    children, _ = _family(runs)

    def lines(client: TrackingStore, run: Run, depth: int) -> Iterator[RunRow]:
        yield RunRow(client, run, tuple(_beneath(run, children)), depth)
        for child in children[run.info.run_id]:
            yield from lines(client, child, depth + 1)

    return [line for entry in entries for line in lines(entry.client, entry.run, 0)]


def sort_rows(entries: Sequence[RunRow], sort: str, *, is_down: bool) -> list[RunRow]:
    """Return entries sorted by what `RunRow.value_of` takes; those without come last, whatever the direction."""
    values = {entry.run.info.run_id: entry.value_of(sort) for entry in entries}
    known = [entry for entry in entries if values[entry.run.info.run_id] is not None]
    known.sort(key=lambda entry: values[entry.run.info.run_id] or 0.0, reverse=is_down)
    return known + [entry for entry in entries if values[entry.run.info.run_id] is None]


def _family(runs: Sequence[Run]) -> tuple[Children, list[Run]]:
    """Return the children of each run by its id, and the runs whose parent is not among them."""
    ids = {run.info.run_id for run in runs}
    children: dict[str, list[Run]] = defaultdict(list)
    tops = []
    for run in sorted(runs, key=lambda run: run.info.start_time):
        parent = run.data.tags.get(PARENT_TAG)
        if parent is not None and parent in ids and parent != run.info.run_id:
            children[parent].append(run)
        else:
            tops.append(run)
    return children, tops


def _beneath(run: Run, children: Children) -> Iterator[Run]:
    for child in children[run.info.run_id]:
        yield child
        yield from _beneath(child, children)

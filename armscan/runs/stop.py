"""Stop a run: a trial's, a study's, or that of a process on this machine."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from mlflow.entities import Run

from armscan.errors import TrackingError
from armscan.tracking.pending_runs import PendingRun
from armscan.tracking.tags import PARENT_TAG, STORAGE_TAG, STUDY_TAG, TRIAL_TAG


@dataclass(frozen=True)
class Target:
    """A trial or a study.

    Args:
        study: Name of the study.
        trial: Number of the trial; None for the whole study.
        runs: MLflow run IDs, one of which the storage has noted: of the run and its parent.
        storage: Address of the study's storage; None if the run does not name one.
    """

    study: str
    trial: int | None
    runs: Collection[str]
    storage: str | None


def target_of(run: Run) -> Target | None:
    """Return the trial or the study that a run belongs to; None if there is none.

    Raises:
        TrackingError: If its tag is not the number of a trial.
    """
    tags = run.data.tags
    if STUDY_TAG not in tags:
        return None
    number = tags.get(TRIAL_TAG)
    if number is not None and not number.isdecimal():
        raise TrackingError(f"run {run.info.run_id}: its tag {TRIAL_TAG} is {number[:50]!r}, but it must be a number")
    # The run of a trial's seed is a child of the trial's.
    runs = {run.info.run_id, tags.get(PARENT_TAG, "")}
    return Target(tags[STUDY_TAG], None if number is None else int(number[:9]), runs, tags.get(STORAGE_TAG))


def interrupt(run: Run) -> str:
    """Interrupt the process of a run outside a study, as Ctrl-C does; return the consequence in one line.

    Raises:
        TrackingError: If it is not running on this machine.
    """
    run_id, pending = run.info.run_id, PendingRun.of(run.info.run_id)
    if run.info.status != "RUNNING":
        raise TrackingError(f"run {run_id} has ended already ({run.info.status})")
    unknown = TrackingError(f"run {run_id} belongs to no study, and this machine knows no process of it")
    if pending is None or not pending.process.is_here or not pending.process.is_alive:
        raise unknown
    try:
        # Runs and evaluations treat both alike.
        os.kill(pending.process.pid, signal.SIGTERM if _ignores_sigint(pending.process.pid) else signal.SIGINT)
    # It has ended since.
    except ProcessLookupError as error:
        raise unknown from error
    return f"run {run_id}: its process {pending.process.pid} was interrupted, and ends as with Ctrl-C"


def _ignores_sigint(pid: int) -> bool:
    """Return whether a process ignores SIGINT, as those do that a shell script starts with `&`; False if unknown."""
    try:
        found = re.search(r"SigIgn:\s*([0-9a-f]+)", Path(f"/proc/{pid}/status").read_text())
    except OSError:
        return False
    return found is not None and bool(int(found[1], 16) >> (signal.SIGINT - 1) & 1)

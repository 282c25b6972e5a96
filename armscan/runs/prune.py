"""Remove what a plan says, run by run, each checked once more."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mlflow.entities import LifecycleStage
from mlflow.exceptions import MlflowException

from armscan.errors import ArmscanError
from armscan.runs.prune_plan import CHECKPOINTS, RUNS, PruneItem, check, related_now
from armscan.runs.run_folder import RunSkippedError, at_rest
from armscan.tracking import TrackingStore, pending
from armscan.tracking.client import NOT_THERE
from armscan.utils.files import SQLITE_PREFIX


class NotRemovedError(ArmscanError):
    """A file of a run cannot be removed; the message says which and why."""


def remove(client: TrackingStore, case: PruneItem, what: str) -> str | None:
    """Remove what a plan says of a run. The run itself is marked as deleted, for `mlflow gc` to remove.

    Args:
        client: the run's store.
        case: the run's part of the plan.
        what: one of `WHAT`.

    Returns:
        Why the folder stays; None if it does not.

    Raises:
        RunSkippedError: if the run must be left as it is now; nothing has been touched.
        NotRemovedError: if a file cannot be removed.
    """
    run_id = case.run.info.run_id
    try:
        with at_rest(case.run) as held:
            # Another process may have begun to use it since it was planned.
            run = client.get_run(run_id)
            if run.info.lifecycle_stage != LifecycleStage.ACTIVE:
                raise RunSkippedError("somebody has deleted it meanwhile")
            folder, note = check(run, what, related_now(client, run, case.related))
            folder = held if folder is not None else None
            if folder is not None:
                _unlink(folder.checkpoints if what == CHECKPOINTS else folder.files)
            if what == RUNS:
                _delete(client, run_id)
            if folder is None or what == CHECKPOINTS:
                return note
            pending.forget(run_id)
            return None if folder.remove_emptied() else f"{folder.path} stays, with what is not the run's"
    except MlflowException as error:
        # Another prune and `mlflow gc` may have removed it between two looks.
        if error.error_code != NOT_THERE:
            raise
        raise RunSkippedError("it is not there any more") from error


def gc_hint(uri: str) -> str:
    """Return how deleted runs are removed from a store."""
    where = f" --backend-store-uri {uri} --tracking-uri {uri}" if uri.startswith(SQLITE_PREFIX) else ""
    return f"MLflow marks runs as deleted, and removes them with their artifacts by: mlflow gc{where}"


def _delete(client: TrackingStore, run_id: str) -> None:
    try:
        client.delete_run(run_id)
    except MlflowException:
        # Another process may just have done the same.
        if client.get_run(run_id).info.lifecycle_stage == LifecycleStage.ACTIVE:
            raise


def _unlink(files: Iterable[Path]) -> None:
    for file in files:
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            raise NotRemovedError(f"{file} cannot be removed: {error.strerror}") from error

"""What a plan would remove is removed, run by run, each looked at once more."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mlflow.entities import LifecycleStage, Run
from mlflow.exceptions import MlflowException
from mlflow.store.artifact.artifact_repository_registry import get_artifact_repository

from armscan.errors import ArmscanError
from armscan.inventory.folders import BusyError, OwnFolder, at_rest
from armscan.inventory.plan import (
    CHECKPOINTS,
    REMOVED_TAG,
    RUNS,
    Case,
    barred_by_folder,
    barred_by_store,
    can_forget,
    folder_left,
    is_half_removed,
    neighbours_now,
)
from armscan.inventory.sizes import local_artifacts
from armscan.tracking import TrackingStore, leftovers
from armscan.tracking.client import NOT_THERE, reason_in

NOT_THERE_ANY_MORE = "it is not there any more"


class LeftError(ArmscanError):
    """Nothing of a run is removed, because that is not safe any more; the message says why."""


class NotRemovedError(ArmscanError):
    """Something of a run cannot be removed; the message says what and why."""


def remove(client: TrackingStore, case: Case, what: str) -> str | None:
    """Removes what a plan says of a run.

    Args:
        client: of its store.
        case: of the plan.
        what: one of `WHAT`.

    Returns:
        What is left of it; None for nothing.

    Raises:
        LeftError: if it must be left now; nothing of it was touched.
        NotRemovedError: if something cannot be removed.
    """
    try:
        with at_rest(case.run) as held:
            # Somebody may have begun to work at it since it was planned.
            run = _as_it_is_now(client, case.run)
            near = neighbours_now(client, run, case.near)
            if left := barred_by_store(run, what, near) or barred_by_folder(run, what, near):
                raise LeftError(left)
            ours = None if folder_left(run, near) else held
            if what == RUNS:
                return _remove_run(client, run, ours) or case.note
            assert ours is not None
            _unlink(ours.checkpoints if what == CHECKPOINTS else ours.files)
            return None if what == CHECKPOINTS else _remove_emptied(ours)
    except BusyError as error:
        raise LeftError(str(error)) from error
    except MlflowException as error:
        # Somebody else may have removed it between two looks.
        if error.error_code != NOT_THERE:
            raise
        raise LeftError(NOT_THERE_ANY_MORE) from error


def _as_it_is_now(client: TrackingStore, run: Run) -> Run:
    run_id = run.info.run_id
    try:
        now: Run = client.get_run(run_id)
    except MlflowException as error:
        if error.error_code != NOT_THERE:
            raise
        raise LeftError(NOT_THERE_ANY_MORE) from error
    is_going_on = is_half_removed(run) and is_half_removed(now)
    if now.info.lifecycle_stage != LifecycleStage.ACTIVE and not is_going_on:
        raise LeftError("somebody has deleted it meanwhile")
    return now


def _remove_run(client: TrackingStore, run: Run, ours: OwnFolder | None) -> str | None:
    """Removes a run from its store, with its artifacts and, where it is on this machine, its folder."""
    run_id = run.info.run_id
    _mark_deleted(client, run)
    try:
        _remove_artifacts(client, run)
        if ours is not None:
            _unlink(ours.files)
    except BaseException:
        # So that it can be tried again, also after Ctrl-C.
        client.restore_run(run_id)
        client.delete_tag(run_id, REMOVED_TAG)
        raise
    left = _remove_emptied(ours) if ours else None
    return _forget(client, run_id) or left


def _mark_deleted(client: TrackingStore, run: Run) -> None:
    """Has MLflow hide a run: from here on only who removes the rest of it finds it."""
    if is_half_removed(run):
        return
    try:
        client.set_tag(run.info.run_id, REMOVED_TAG, "begun")
        client.delete_run(run.info.run_id)
    except MlflowException:
        # Where somebody else was faster, that is said.
        _as_it_is_now(client, run)
        raise


def _remove_artifacts(client: TrackingStore, run: Run) -> None:
    folder = local_artifacts(run)
    try:
        if folder is None:
            kept: Any = get_artifact_repository(run.info.artifact_uri, tracking_uri=client.mlflow.tracking_uri)
            kept.delete_artifacts()
        elif folder.is_dir():
            _remove_tree(folder)
            if folder.parent.name == run.info.run_id:
                with contextlib.suppress(OSError):
                    folder.parent.rmdir()
    # Whatever a store of artifacts raises.
    except Exception as error:
        raise NotRemovedError(
            f"its artifacts in {run.info.artifact_uri} cannot be removed: {reason_in(error)}"
        ) from error


def _remove_tree(folder: Path) -> None:
    while folder.is_dir():
        # Somebody else may be removing it, too.
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(folder)


def _unlink(files: Iterable[Path]) -> None:
    for file in files:
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            raise NotRemovedError(f"{file} cannot be removed: {error.strerror}") from error


def _remove_emptied(ours: OwnFolder) -> str | None:
    """Removes the folder of a run where nothing is left in it; otherwise returns that it stays."""
    leftovers.forget(ours.run_id)
    return None if ours.remove_emptied() else f"{ours.path} stays, with what is not the run's"


def _forget(client: TrackingStore, run_id: str) -> str | None:
    """Removes a deleted run's rows from a database; a server does that itself, and it is returned how."""
    if not can_forget(client):
        return "on the server, its figures are those of a deleted run until `mlflow gc` removes them there"
    client.mlflow._tracking_client.store._hard_delete_run(run_id)
    return None

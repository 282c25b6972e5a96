"""What would be removed of runs, what is left of them, and why: looked at, and nothing touched."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from mlflow.entities import LifecycleStage, Run, ViewType

import armscan
from armscan.inventory.entries import PARENT_TAG
from armscan.inventory.folders import BusyError, NotOursError, OwnFolder, bytes_of, check_at_rest
from armscan.inventory.selection import Selection, all_pages, experiment_ids, find, search
from armscan.inventory.sizes import Sizes
from armscan.tracking import TrackingStore
from armscan.tracking.finding import release
from armscan.tracking.sync import ENDED

CHECKPOINTS, FOLDERS, RUNS = "checkpoints", "folders", "runs"
WHAT = (CHECKPOINTS, FOLDERS, RUNS)
VERSION_TAG = "armscan.version"
# Of a run whose removal has begun, by which the rest of it is found where that was cut off.
REMOVED_TAG = "armscan.removed"


@dataclass(frozen=True)
class Neighbours:
    """What else is in the store, as far as the removal of a run depends on it.

    Args:
        parent: of the run; None where there is none.
        children: their ids.
        is_registered: whether a version of a registered model is of the run.
        sharing: the id of another run that has noted the same folder; None for none.
    """

    parent: Run | None
    children: frozenset[str]
    is_registered: bool
    sharing: str | None


@dataclass(frozen=True)
class Case:
    """What is to become of a run.

    Args:
        run: the run.
        near: what else is in the store.
        n_bytes: that its removal frees.
        left: why nothing of it is removed; None where it is.
        note: what is left of it all the same; None for nothing.
    """

    run: Run
    near: Neighbours
    n_bytes: int = 0
    left: str | None = None
    note: str | None = None


def plan(client: TrackingStore, runs: Sequence[Run], what: str, sizes: Sizes) -> list[Case]:
    """Returns what is to become of runs, children before their parents.

    Args:
        client: of their store.
        runs: that are meant.
        what: one of `WHAT`.
        sizes: measures them.
    """
    near = neighbours(client, runs)
    removed: set[str] = set()
    cases = []
    for run in _children_first(runs):
        run_id = run.info.run_id
        if left := _reason_to_leave(run, what, near[run_id], removed):
            cases.append(Case(run, near[run_id], left=left))
            continue
        try:
            n_bytes = _freed(run, what, near[run_id], sizes)
        except NotOursError as error:
            # Somebody has removed it since the look before.
            cases.append(Case(run, near[run_id], left=str(error)))
            continue
        if what != RUNS and n_bytes == 0:
            kind = "checkpoint" if what == CHECKPOINTS else "file"
            cases.append(Case(run, near[run_id], left=f"its folder holds no {kind} of it"))
            continue
        removed.add(run_id)
        cases.append(Case(run, near[run_id], n_bytes, note=folder_left(run, near[run_id]) if what == RUNS else None))
    return cases


def half_removed(client: TrackingStore, selection: Selection, sizes: Sizes) -> list[Run]:
    """Returns the runs of a store that are meant, and of which a removal that was cut off has left something.

    Args:
        client: of the store.
        selection: which runs are meant.
        sizes: measures them.
    """
    # A server keeps the figures of a removed run; where they can be removed from here, they are a rest, too.
    is_all = can_forget(client)
    found = [run for run in find(client, selection, ViewType.DELETED_ONLY) if is_half_removed(run)]
    return [run for run in found if is_all or sizes.of(run).n_bytes]


def is_half_removed(run: Run) -> bool:
    """Whether the removal of a run has begun; one that somebody else has deleted can be restored, and is not ours."""
    return run.info.lifecycle_stage == LifecycleStage.DELETED and REMOVED_TAG in run.data.tags


def can_forget(client: TrackingStore) -> bool:
    """Whether the rows of a deleted run can be removed from here: from a database, not from a server."""
    # What `mlflow gc` calls; the versions of MLflow that are allowed all have it.
    return hasattr(client.mlflow._tracking_client.store, "_hard_delete_run")


def _reason_to_leave(run: Run, what: str, near: Neighbours, removed: Collection[str]) -> str | None:
    """Returns why nothing of a run may be removed; None where it may."""
    try:
        check_at_rest(run)
    except BusyError as error:
        return str(error)
    return barred_by_store(run, what, near, removed) or barred_by_folder(run, what, near)


def barred_by_store(run: Run, what: str, near: Neighbours, removed: Collection[str] = ()) -> str | None:
    """Returns why nothing of a run may be removed, by what stands in the store; None where it may.

    Args:
        run: as it stands now.
        what: one of `WHAT`.
        near: what else is in the store.
        removed: ids of children that will be gone by then.
    """
    made_by = run.data.tags.get(VERSION_TAG, armscan.__version__)
    if release(made_by) > release(armscan.__version__):
        return f"it was made by armscan {made_by}, which is newer than this, {armscan.__version__}"
    if run.info.status not in ENDED and what != RUNS:
        return f"it is {run.info.status}, and could be gone on with from there"
    if near.parent is not None and near.parent.info.status not in ENDED:
        return f"its parent, run {near.parent.info.run_id}, is {near.parent.info.status}, and may go on with it"
    if near.is_registered:
        return "a version of a registered model is kept by it"
    if what == RUNS and (staying := sorted(near.children.difference(removed))):
        return f"{len(staying)} of its children stay, such as run {staying[0]}"
    if what == RUNS and run.info.run_id not in Path(run.info.artifact_uri).parts:
        return f"its artifacts are in {run.info.artifact_uri}, which is no place of its own"
    return None


def barred_by_folder(run: Run, what: str, near: Neighbours) -> str | None:
    """Returns why nothing of a run may be removed, by what is known of its folder; None where it may."""
    if what == RUNS and (run.info.status in ENDED or is_half_removed(run)):
        return None
    try:
        _check_own(run, near)
    except NotOursError as error:
        if what != RUNS:
            return str(error)
        return f"it is {run.info.status}, and nobody can tell from here whether it goes on: {error}"
    return None


def folder_left(run: Run, near: Neighbours) -> str | None:
    """Returns why the folder of a run stays that is removed; None where it does not, or there is none."""
    try:
        _check_own(run, near)
    except NotOursError as error:
        return str(error) if error.is_there else None
    return None


def neighbours(client: TrackingStore, runs: Sequence[Run]) -> dict[str, Neighbours]:
    """Returns what the removal of runs depends on, by their ids; asks for all of the store at once."""
    everything = search(client, experiment_ids(client))
    by_id = {run.info.run_id: run for run in everything}
    children, folders = defaultdict(set), defaultdict(set)
    for run in everything:
        children[run.data.tags.get(PARENT_TAG)].add(run.info.run_id)
        folders[run.data.tags.get("folder")].add(run.info.run_id)
    registered = {version.run_id for version in all_pages(client.search_model_versions)}
    found = {}
    for run in runs:
        run_id, folder = run.info.run_id, run.data.tags.get("folder")
        sharing = sorted(folders[folder] - {run_id}) if folder else []
        found[run_id] = Neighbours(
            parent=by_id.get(run.data.tags.get(PARENT_TAG, "")),
            children=frozenset(children[run_id]),
            is_registered=run_id in registered,
            sharing=sharing[0] if sharing else None,
        )
    return found


def neighbours_now(client: TrackingStore, run: Run, before: Neighbours) -> Neighbours:
    """Returns what the removal of one run depends on now; who shares its folder its files tell."""
    run_id = run.info.run_id
    children = search(client, experiment_ids(client), f"tags.mlflow.parentRunId = '{run_id}'")
    return Neighbours(
        parent=None if before.parent is None else client.get_run(before.parent.info.run_id),
        children=frozenset(child.info.run_id for child in children),
        is_registered=bool(client.search_model_versions(f"run_id = '{run_id}'", max_results=1)),
        sharing=before.sharing,
    )


def _check_own(run: Run, near: Neighbours) -> OwnFolder:
    """Returns the folder of a run.

    Raises:
        NotOursError: if there is none that is the run's alone.
    """
    ours = OwnFolder.of(run)
    if near.sharing is not None:
        raise NotOursError(f"{ours.path} is the folder of run {near.sharing}, too")
    return ours


def _freed(run: Run, what: str, near: Neighbours, sizes: Sizes) -> int:
    if what == CHECKPOINTS:
        return bytes_of(OwnFolder.of(run).checkpoints)
    if what == FOLDERS:
        return OwnFolder.of(run).n_bytes
    size = sizes.of(run)
    return size.n_bytes - (size.in_folder if folder_left(run, near) else 0)


def _children_first(runs: Sequence[Run]) -> list[Run]:
    parents = {run.info.run_id: run.data.tags.get(PARENT_TAG) for run in runs}

    def depth(run: Run) -> int:
        above: list[str] = []
        at = parents[run.info.run_id]
        while at is not None and at in parents and at not in above:
            above.append(at)
            at = parents[at]
        return len(above)

    return sorted(runs, key=depth, reverse=True)

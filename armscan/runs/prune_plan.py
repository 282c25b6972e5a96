"""Plan a prune: what to remove of which runs, and why the others are skipped."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from mlflow.entities import Run

import armscan
from armscan.runs.query import all_pages, experiment_ids, search
from armscan.runs.rows import PARENT_TAG
from armscan.runs.run_folder import FolderNotOwnedError, OwnFolder, RunSkippedError, bytes_of, check_at_rest
from armscan.tracking import TrackingStore
from armscan.tracking.lookup import VERSION_TAG, release
from armscan.tracking.sync import ENDED

CHECKPOINTS, FOLDERS, RUNS = "checkpoints", "folders", "runs"
WHAT = (CHECKPOINTS, FOLDERS, RUNS)


@dataclass(frozen=True)
class Related:
    """What else in the store decides whether a run may be removed.

    Args:
        parent: the run's parent; None if it has none.
        children: run IDs of its children.
        is_registered: whether a version of a registered model belongs to the run.
        sharing: ID of another run with the same folder; None if there is none.
    """

    parent: Run | None
    children: frozenset[str]
    is_registered: bool
    sharing: str | None


@dataclass(frozen=True)
class PruneItem:
    """What is to become of a run.

    Args:
        run: the run.
        related: what else is in the store.
        n_bytes: disk space that its removal frees.
        left: why the run is left as it is; None if it is not.
        note: why its folder stays; None if it does not, or there is none.
    """

    run: Run
    related: Related
    n_bytes: int = 0
    left: str | None = None
    note: str | None = None


def plan(client: TrackingStore, runs: Sequence[Run], what: str) -> list[PruneItem]:
    """Return what is to become of runs, children before their parents.

    Args:
        client: their store.
        runs: the selected runs.
        what: one of `WHAT`.
    """
    related = _related(client, runs)
    removed: set[str] = set()
    cases = []
    for run in _children_first(runs):
        run_id = run.info.run_id
        case = _case(run, what, related[run_id], removed)
        if case.left is None:
            removed.add(run_id)
        cases.append(case)
    return cases


def _case(run: Run, what: str, related: Related, removed: Collection[str]) -> PruneItem:
    try:
        check_at_rest(run)
        folder, note = check(run, what, related, removed)
    except RunSkippedError as error:
        return PruneItem(run, related, left=str(error))
    if folder is None:
        return PruneItem(run, related, note=note)
    files = folder.checkpoints if what == CHECKPOINTS else folder.files
    if what != RUNS and not files:
        kind = "checkpoint" if what == CHECKPOINTS else "file"
        return PruneItem(run, related, left=f"its folder holds no {kind} of it")
    return PruneItem(run, related, bytes_of(files))


def check(run: Run, what: str, related: Related, removed: Collection[str] = ()) -> tuple[OwnFolder | None, str | None]:
    """Return the folder to remove files from, or None and why the folder stays, if there is one.

    Args:
        run: the run as it is now.
        what: one of `WHAT`.
        related: what else is in the store.
        removed: IDs of children that will be removed before.

    Raises:
        RunSkippedError: if the run must be left as it is.
    """
    _check_store(run, what, related, removed)
    try:
        folder = OwnFolder.of(run, sharing=related.sharing)
    except FolderNotOwnedError as error:
        if what != RUNS:
            raise RunSkippedError(str(error)) from error
        if run.info.status not in ENDED:
            raise RunSkippedError(
                f"it is {run.info.status}, and nobody can tell from here whether it goes on: {error}"
            ) from error
        return None, str(error) if error.is_there else None
    return folder, None


def _check_store(run: Run, what: str, related: Related, removed: Collection[str]) -> None:
    """Raise `RunSkippedError` if the store says that a run must be left as it is."""
    status, made_by = run.info.status, run.data.tags.get(VERSION_TAG, armscan.__version__)
    if release(made_by) > release(armscan.__version__):
        raise RunSkippedError(f"it was made by armscan {made_by}, which is newer than this, {armscan.__version__}")
    if status not in ENDED and what != RUNS:
        raise RunSkippedError(f"it is {status}, and could be resumed from there")
    if (parent := related.parent) is not None and parent.info.status not in ENDED:
        raise RunSkippedError(f"its parent, run {parent.info.run_id}, is {parent.info.status}, and may resume it")
    if related.is_registered:
        raise RunSkippedError("a version of a registered model belongs to it")
    if what == RUNS and (staying := sorted(related.children.difference(removed))):
        raise RunSkippedError(f"{len(staying)} of its children stay, such as run {staying[0]}")


def _related(client: TrackingStore, runs: Sequence[Run]) -> dict[str, Related]:
    """Return what decides about runs by their IDs, from one look at the whole store."""
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
        found[run_id] = Related(
            parent=by_id.get(run.data.tags.get(PARENT_TAG, "")),
            children=frozenset(children[run_id]),
            is_registered=run_id in registered,
            sharing=sharing[0] if sharing else None,
        )
    return found


def related_now(client: TrackingStore, run: Run, before: Related) -> Related:
    """Return what decides about one run now. Files tell whether another run shares its folder by now."""
    run_id = run.info.run_id
    children = search(client, experiment_ids(client), f"tags.{PARENT_TAG} = '{run_id}'")
    return Related(
        parent=None if before.parent is None else client.get_run(before.parent.info.run_id),
        children=frozenset(child.info.run_id for child in children),
        is_registered=bool(client.search_model_versions(f"run_id = '{run_id}'", max_results=1)),
        sharing=before.sharing,
    )


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

"""Selection of runs in a store."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Sequence
from datetime import datetime

from mlflow.entities import Run
from mlflow.exceptions import MlflowException

from armscan.errors import InvalidValueError, listed
from armscan.tracking import TrackingStore, find_run
from armscan.tracking.tags import AGENT_TAG, OBS_TAG, PARENT_TAG
from armscan.tracking.tracking_store import all_pages, reason_in


def find_runs(
    store: TrackingStore,
    *,
    experiment: str | None = None,
    parent: str | None = None,
    status: Collection[str] | None = None,
    agent: Collection[str] | None = None,
    obs: Collection[str] | None = None,
    projection: str | None = None,
    since: datetime | None = None,
    before: datetime | None = None,
    where: str | None = None,
) -> list[Run]:
    """Return the runs of a store that match all criteria, in no particular order. Default: all runs.

    Args:
        store: Tracking store.
        experiment: Name of the MLflow experiment.
        parent: MLflow run ID of the parent run, or its first characters.
        status: Allowed statuses, in lower case.
        agent: Names of allowed agents.
        obs: Names of allowed observations.
        projection: Allowed projections: names separated by commas, or a list of components in brackets.
        since: Earliest start, inclusive.
        before: Latest start, exclusive.
        where: MLflow filter string.

    Raises:
        InvalidValueError: If there is no such experiment, or MLflow rejects the filter.
        TrackingError: If there is no such parent.
    """
    experiments = experiment_ids(store, experiment)
    conditions = [
        f"attributes.start_time {sign} {round(moment.timestamp() * 1000)}"
        for sign, moment in ((">=", since), ("<", before))
        if moment is not None
    ]
    conditions += [where] if where else []
    below = None if parent is None else _below(store.runs(experiments), find_run(store, parent).info.run_id)
    try:
        runs = store.runs(experiments, " and ".join(conditions))
    except MlflowException as error:
        if where is None or error.error_code != "INVALID_PARAMETER_VALUE":
            raise
        raise InvalidValueError(f"--where is {where!r}, but MLflow rejects this filter: {reason_in(error)}") from error
    projections = _projection_params(projection) if projection else None

    def is_fit(run: Run) -> bool:
        tags, given = run.data.tags, projection_of(run)
        values = (run.info.status.lower(), tags.get(AGENT_TAG), tags.get(OBS_TAG), given)
        allowed = (status, agent, obs, projections)
        return all(not some or value in some for value, some in zip(values, allowed, strict=True))

    return [run for run in runs if is_fit(run) and (below is None or run.info.run_id in below)]


def _below(runs: Sequence[Run], parent_id: str) -> set[str]:
    """Return the IDs of all runs below a run, such as the trials of a study and their trainings."""
    children: dict[str, list[str]] = defaultdict(list)
    for run in runs:
        children[run.data.tags.get(PARENT_TAG, "")].append(run.info.run_id)
    found, level = set(), [parent_id]
    while level:
        level = [child for each in level for child in children[each] if child not in found]
        found.update(level)
    return found


def projection_of(run: Run) -> str | None:
    """Return the projection of a run's environment, as it is written in its parameters; None if it has none."""
    return run.data.params.get("env.projection", run.data.params.get("projection"))


def _projection_params(text: str) -> tuple[str, ...]:
    """Return projections as they are written in the parameters of runs."""
    if text.startswith("["):
        return (json.dumps([part.strip() for part in text.strip("[]").split(",")]),)
    return tuple(part.strip() for part in text.split(","))


def experiment_ids(store: TrackingStore, name: str | None = None) -> list[str]:
    """Return the IDs of experiments.

    Args:
        store: Tracking store of the experiments.
        name: Name of the only experiment. Default: None, all of the store.

    Raises:
        InvalidValueError: If there is no experiment with this name.
    """
    experiments = all_pages(store.search_experiments)
    found = [each.experiment_id for each in experiments if name in (None, each.name)]
    if not found and name is not None:
        there = f"only {listed(each.name for each in experiments)}" if experiments else "none"
        raise InvalidValueError(f"--experiment is {name!r}, but {store.uri} has {there}")
    return found

"""Which runs are meant: the words that say it, and the runs of a store that they fit."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from mlflow.entities import Run
from mlflow.exceptions import MlflowException

from armscan.errors import InvalidValueError, listed
from armscan.tracking import TrackingStore, find_run
from armscan.tracking.client import reason_in

PER_PAGE = 1000


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Which runs are meant, in which order. Default: all, the newest first.

    Args:
        experiment: name of their MLflow experiment.
        parent: MLflow run ID of the run that they are children of, or its first characters.
        statuses: statuses as MLflow writes them.
        choices: allowed values of tags, by the tag's name.
        projections: projections, as parameters of runs have them.
        since: earliest start.
        before: time before which they were started.
        where: MLflow filter string.
        sort: what they are sorted by, as `RunRow.value_of` takes it.
        is_down: whether the greatest come first.
        limit: number of runs at most.
    """

    experiment: str | None = None
    parent: str | None = None
    statuses: frozenset[str] = frozenset()
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    projections: tuple[str, ...] = ()
    since: datetime | None = None
    before: datetime | None = None
    where: str | None = None
    sort: str = "started"
    is_down: bool = True
    limit: int | None = None

    def is_fit(self, run: Run) -> bool:
        """Whether a run is meant, as far as the store was not asked."""
        tags = run.data.tags
        return (
            (not self.statuses or run.info.status in self.statuses)
            and all(tags.get(tag) in allowed for tag, allowed in self.choices.items())
            and (not self.projections or run.data.params.get("projection") in self.projections)
        )

    @property
    def filter(self) -> str:
        """What the store is asked for."""
        parts = [
            f"attributes.start_time {sign} {round(moment.timestamp() * 1000)}"
            for sign, moment in ((">=", self.since), ("<", self.before))
            if moment is not None
        ]
        return " and ".join(parts + ([self.where] if self.where else []))


def projection_params(text: str) -> tuple[str, ...]:
    """Return projections, given as names or a list of components, as parameters of runs have them."""
    if text.startswith("["):
        return (json.dumps([part.strip() for part in text.strip("[]").split(",")]),)
    return tuple(text.split(","))


def find(client: TrackingStore, selection: Selection) -> list[Run]:
    """Return the runs of a store that are meant, in no order.

    Args:
        client: the store.
        selection: which are meant.

    Raises:
        InvalidValueError: if there is no such experiment, or MLflow does not take the filter.
        TrackingError: if there is no such parent.
    """
    experiments = experiment_ids(client, selection.experiment)
    conditions = [selection.filter] if selection.filter else []
    if selection.parent is not None:
        conditions.append(f"tags.mlflow.parentRunId = '{find_run(client, selection.parent).info.run_id}'")
    try:
        runs = search(client, experiments, " and ".join(conditions))
    except MlflowException as error:
        if selection.where is None or error.error_code != "INVALID_PARAMETER_VALUE":
            raise
        raise InvalidValueError(
            f"--where is {selection.where!r}, but MLflow takes no such filter: {reason_in(error)}"
        ) from error
    return [run for run in runs if selection.is_fit(run)]


def experiment_ids(client: TrackingStore, name: str | None = None) -> list[str]:
    """Return the ids of all experiments of a store, or of the one of a name.

    Raises:
        InvalidValueError: if there is none of that name.
    """
    experiments = all_pages(client.search_experiments)
    found = [each.experiment_id for each in experiments if name in (None, each.name)]
    if not found and name is not None:
        there = listed(each.name for each in experiments) if experiments else "none"
        raise InvalidValueError(f"--experiment is {name!r}, but {client.uri} has only {there}")
    return found


def search(client: TrackingStore, experiments: list[str], condition: str = "") -> list[Run]:
    """Return all runs of experiments that a filter of MLflow lets through."""
    if not experiments:
        return []
    return all_pages(lambda **page: client.search_runs(experiments, filter_string=condition, **page))


def all_pages(ask: Callable[..., Any]) -> list[Any]:
    """Return everything that MLflow tells page by page."""
    found: list[Any] = []
    token = None
    while True:
        page = ask(max_results=PER_PAGE, page_token=token)
        found += page
        if not (token := page.token):
            return found

"""Which runs are meant: the words that say it, and the runs of a store that they fit."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

from mlflow.entities import Run, ViewType
from mlflow.exceptions import MlflowException

from armscan.checks import check_int
from armscan.errors import InvalidValueError, listed
from armscan.inventory.entries import SORTS
from armscan.tracking import TrackingStore, find_run
from armscan.tracking.client import reason_in

STATUSES = ("finished", "failed", "killed", "running")
# What was chosen of each group, as its tag has it.
CHOICES = {"agent": "choice.agent", "obs": "choice.obs"}

AGE = re.compile(r"(\d+(?:\.\d+)?)([mhdw])")
UNITS = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
PER_PAGE = 1000


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Which runs are meant; of what is None or empty, all.

    Args:
        experiment: of MLflow, by its name.
        parent: the run that they are children of, or the beginning of its id.
        statuses: as MLflow writes them.
        choices: the values allowed of a tag, by its name.
        projections: as parameters have them.
        since: they were started then or later.
        before: they were started earlier.
        where: a filter of MLflow.
        sort: by what, one of `SORTS`.
        is_down: the greatest first.
        limit: so many.
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


def read_selection(values: Mapping[str, Any]) -> Selection:
    """Returns which runs the values of words mean.

    Args:
        values: by key, of `FILTERS`; texts, but `limit`.

    Raises:
        InvalidValueError: if a value is not allowed.
    """
    sort = values.get("sort", "-started")
    if sort.removeprefix("-") not in SORTS:
        raise InvalidValueError(f"sort is {sort!r}, but it must be {listed(SORTS)}, with a - before it for descending")
    statuses = _parts(values, "status")
    if unknown := [status for status in statuses if status not in STATUSES]:
        raise InvalidValueError(f"status is {unknown[0]!r}, but it must be {listed(STATUSES)}, several with commas")
    limit = values.get("limit")
    return Selection(
        experiment=values.get("experiment"),
        parent=values.get("parent"),
        statuses=frozenset(status.upper() for status in statuses),
        choices={tag: _parts(values, key) for key, tag in CHOICES.items() if key in values},
        projections=_projections(values["projection"]) if "projection" in values else (),
        since=_moment("since", values["since"]) if "since" in values else None,
        before=_moment("before", values["before"]) if "before" in values else None,
        where=values.get("where"),
        sort=sort.removeprefix("-"),
        is_down=sort.startswith("-"),
        limit=None if limit is None else check_int("limit", limit, at_least=1),
    )


def _parts(values: Mapping[str, Any], key: str) -> tuple[str, ...]:
    return tuple(str(values[key]).split(",")) if key in values else ()


def _projections(text: str) -> tuple[str, ...]:
    """Returns names of projections, or a list of components, as parameters have them."""
    if text.startswith("["):
        return (json.dumps([part.strip() for part in text.strip("[]").split(",")]),)
    return tuple(text.split(","))


def _moment(key: str, text: str) -> datetime:
    """Returns the moment that a date, with a time or without, or an age such as 7d is."""
    if age := AGE.fullmatch(text):
        try:
            return datetime.now().astimezone() - timedelta(**{UNITS[age[2]]: float(age[1])})
        except OverflowError:
            pass
    else:
        try:
            return datetime.fromisoformat(text).astimezone()
        except (ValueError, OverflowError):
            pass
    raise InvalidValueError(
        f"{key} is {text!r}, but it must be an age such as 90m, 12h, 7d or 4w, or a date such as 2026-01-31 or "
        "2026-01-31T18:00"
    )


def find(client: TrackingStore, selection: Selection, view: int = ViewType.ACTIVE_ONLY) -> list[Run]:
    """Returns the runs of a store that are meant, in no order.

    Args:
        client: of the store.
        selection: which are meant.
        view: of MLflow: those that are there, or those that were deleted.

    Raises:
        InvalidValueError: if there is no such experiment, or MLflow does not take the filter.
        TrackingError: if there is no such parent.
    """
    experiments = experiment_ids(client, selection.experiment)
    condition = selection.filter
    if selection.parent is not None:
        parent = find_run(client, selection.parent)
        ours = f"tags.mlflow.parentRunId = '{parent.info.run_id}'"
        condition = f"{ours} and {condition}" if condition else ours
    try:
        runs = search(client, experiments, condition, view)
    except MlflowException as error:
        if selection.where is None or error.error_code != "INVALID_PARAMETER_VALUE":
            raise
        raise InvalidValueError(
            f"where is {selection.where!r}, but MLflow takes no such filter: {reason_in(error)}"
        ) from error
    return [run for run in runs if selection.is_fit(run)]


def experiment_ids(client: TrackingStore, name: str | None = None) -> list[str]:
    """Returns the ids of all experiments of a store, or of the one of a name.

    Raises:
        InvalidValueError: if there is none of that name.
    """
    experiments = all_pages(client.search_experiments)
    found = [each.experiment_id for each in experiments if name in (None, each.name)]
    if not found and name is not None:
        there = listed(each.name for each in experiments) if experiments else "none"
        raise InvalidValueError(f"experiment is {name!r}, but {client.uri} has only {there}")
    return found


def search(
    client: TrackingStore, experiments: list[str], condition: str = "", view: int = ViewType.ACTIVE_ONLY
) -> list[Run]:
    """Returns all runs of experiments that a filter of MLflow lets through."""
    if not experiments:
        return []
    return all_pages(
        lambda **page: client.search_runs(experiments, filter_string=condition, run_view_type=view, **page)
    )


def all_pages(ask: Callable[..., Any]) -> list[Any]:
    """Returns everything that MLflow tells page by page."""
    found: list[Any] = []
    token = None
    while True:
        page = ask(max_results=PER_PAGE, page_token=token)
        found += page
        if not (token := page.token):
            return found

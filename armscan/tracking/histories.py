"""Metric histories of many runs, with one request per metric instead of one per run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from armscan.tracking.tracking_store import TrackingStore

if TYPE_CHECKING:
    from mlflow import MlflowClient

# An MLflow server's limits per request, also kept for a database.
MAX_RUNS, MAX_POINTS = 100, 25_000
# Route of MLflow's own UI: `MlflowClient` has no such request.
ROUTE = "/ajax-api/2.0/mlflow/metrics/get-history-bulk"

History = dict[int, float]
# MLflow run ID, step and value.
Point = tuple[str, int, float]


def metric_histories(store: TrackingStore, names: Mapping[str, Collection[str]]) -> dict[str, dict[str, History]]:
    """Return histories of metrics.

    Args:
        store: Store of the runs; requests are not retried.
        names: Names of the requested metrics, by MLflow run ID.

    Returns:
        The values by run ID, metric name and step; the last one if a step has several.
    """
    runs_of: dict[str, list[str]] = defaultdict(list)
    histories: dict[str, dict[str, History]] = {run_id: {name: {} for name in names[run_id]} for run_id in names}
    for run_id, wanted in names.items():
        for name in wanted:
            runs_of[name].append(run_id)
    for name, run_ids in runs_of.items():
        for first in range(0, len(run_ids), MAX_RUNS):
            for run_id, step, value in _points(store.mlflow, run_ids[first : first + MAX_RUNS], name):
                histories[run_id][name][step] = value
    return histories


def _points(client: MlflowClient, run_ids: Sequence[str], name: str) -> Iterator[Point]:
    """Yield all points of a metric, for each run in the order in which they were logged."""
    found = _bulk(client, run_ids, name)
    if found is not None and len(found) < MAX_POINTS:
        yield from found
    elif found is not None and len(run_ids) > 1:
        # The reply was truncated.
        middle = len(run_ids) // 2
        yield from _points(client, run_ids[:middle], name)
        yield from _points(client, run_ids[middle:], name)
    else:
        for run_id in run_ids:
            yield from ((run_id, each.step, each.value) for each in client.get_metric_history(run_id, name))


def _bulk(client: MlflowClient, run_ids: Sequence[str], name: str) -> list[Point] | None:
    """Return at most `MAX_POINTS` points of a metric; None if the store does not support such a request."""
    store: Any = client._tracking_client.store
    if hasattr(store, "get_metric_history_bulk"):
        points = store.get_metric_history_bulk(run_ids, name, MAX_POINTS)
        return [(each.run_id, each.step, each.value) for each in points]
    if not hasattr(store, "get_host_creds"):
        return None
    from mlflow.utils.rest_utils import http_request, verify_rest_response

    asked = {"run_id": run_ids, "metric_key": name, "max_results": MAX_POINTS}
    request: Any = http_request
    response = request(store.get_host_creds(), ROUTE, "GET", params=asked)
    if response.status_code == HTTPStatus.NOT_FOUND:
        return None
    answer = verify_rest_response(response, ROUTE).json()
    return [(each["run_id"], each["step"], each["value"]) for each in answer["metrics"]]

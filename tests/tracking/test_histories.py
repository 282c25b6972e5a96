"""Histories of many runs at once: the same as one by one, from a database and through a server."""

from functools import partial

import pytest
from mlflow import MlflowClient
from mlflow.entities import Metric

from armscan.tracking import histories, open_existing_store
from armscan.tracking.histories import metric_histories
from tests.support.mlflow_server import mlflow_server


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a store of five runs: its address, and the names of the metrics of each run."""
    folder = tmp_path_factory.mktemp("histories")
    uri = f"sqlite:///{folder}/runs.db"
    client = MlflowClient(uri)
    names = {}
    for number in range(5):
        run_id = client.create_run("0").info.run_id
        names[run_id] = {"x", "wall_s"} if number % 2 else {"x"}
        # The last of two values at one step counts.
        points = [Metric("x", value, at_ms, step) for at_ms, (value, step) in enumerate([(0.1, 5), (2.0, 9), (0.3, 5)])]
        client.log_batch(run_id, [*points, Metric("wall_s", number, 0, 5), Metric("other", 1.0, 0, 0)])
    return uri, names


@pytest.fixture(params=["a database", pytest.param("a server", marks=pytest.mark.full)])
def store(request, made, tmp_path):
    if request.param == "a database":
        yield open_existing_store(made[0])
    else:
        with mlflow_server(tmp_path, made[0]) as server:
            yield open_existing_store(server.uri)


def one_by_one(uri, names):
    history = partial(MlflowClient(uri).get_metric_history)
    return {
        run_id: {name: {p.step: p.value for p in history(run_id, name)} for name in names[run_id]} for run_id in names
    }


def test_histories_of_many_runs_are_those_of_each(store, made, monkeypatch):
    asked = one_by_one(*made)
    assert all(each["x"] == {5: 0.3, 9: 2.0} for each in asked.values())
    assert metric_histories(store, made[1]) == asked
    # Split as requests are that would be longer than a server answers.
    monkeypatch.setattr(histories, "MAX_RUNS", 2)
    monkeypatch.setattr(histories, "MAX_POINTS", 4)
    assert metric_histories(store, made[1]) == asked


def test_stores_without_such_a_request_are_asked_run_by_run(store, made, monkeypatch):
    monkeypatch.setattr(histories, "_bulk", lambda *_: None)
    assert metric_histories(store, made[1]) == one_by_one(*made)

"""A run in the store by its id, or by as much of the id as tells it from the others."""

from __future__ import annotations

import re

from mlflow import MlflowClient
from mlflow.entities import Run

from armscan.errors import TrackingError, listed

ID = re.compile(r"[0-9a-f]{1,32}")
MAX_EXPERIMENTS = 1000
N_SHOWN = 4


def find_run(client: MlflowClient, run_id: str) -> Run:
    """Returns the run of an id.

    Args:
        client: of an open store.
        run_id: the id, or a beginning of it that no other run's has, in any experiment of the store.

    Raises:
        TrackingError: if no run is meant, or several are.
    """
    if not ID.fullmatch(run_id):
        raise TrackingError(
            f"the run is {run_id!r}, but it must be an id as MLflow shows it, or its beginning: up to 32 of 0-9 and a-f"
        )
    experiments = client.search_experiments(max_results=MAX_EXPERIMENTS)
    found = client.search_runs(
        [experiment.experiment_id for experiment in experiments],
        filter_string=f"attributes.run_id LIKE '{run_id}%'",
        max_results=N_SHOWN + 1,
    )
    if not found:
        raise TrackingError(f"the run is {run_id!r}, but no run of {client.tracking_uri} has an id that begins so")
    if len(found) > 1:
        ids = [run.info.run_id for run in found[:N_SHOWN]] + (["others"] if len(found) > N_SHOWN else [])
        raise TrackingError(f"the run is {run_id!r}, but that may be {listed(ids)}: give more of the id")
    return found[0]

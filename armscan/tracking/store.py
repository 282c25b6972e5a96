"""The MLflow store: opened once, by one process at a time."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock
from mlflow import MlflowClient
from mlflow.exceptions import MlflowException
from sqlalchemy.exc import SQLAlchemyError

from armscan.errors import TrackingError

SQLITE_PREFIX = "sqlite:///"
EXAMPLES = {"uri": "sqlite:///mlruns.db", "experiment": "armscan", "artifacts": "mlartifacts"}
LOCK_TIMEOUT_S = 120
# A server that is away should be said to be away within seconds, not after minutes of retries.
HTTP_DEFAULTS = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2", "MLFLOW_HTTP_REQUEST_TIMEOUT": "20"}


def open_store(uri: str, *, experiment: str, artifacts: str) -> tuple[MlflowClient, str]:
    """Opens a tracking store and makes the experiment where it does not exist yet.

    Args:
        uri: of the store, such as `sqlite:///mlruns.db` or the address of an MLflow server.
        experiment: the experiment's name.
        artifacts: folder of its artifacts where the store is a database; a server has its own place for them.

    Returns:
        A client of the store, and the experiment's id.

    Raises:
        TrackingError: if the store cannot be reached or used.
    """
    _check_texts(uri=uri, experiment=experiment, artifacts=artifacts)
    with usable_store(uri):
        return _open_locked(uri, experiment, artifacts)


def open_existing_store(uri: str) -> MlflowClient:
    """Opens a tracking store to look for a run in it, and makes nothing.

    Raises:
        TrackingError: if there is none, or it cannot be used.
    """
    _check_texts(uri=uri)
    if uri.startswith(SQLITE_PREFIX):
        database = Path(uri.removeprefix(SQLITE_PREFIX)).absolute()
        if not database.is_file():
            raise TrackingError(f"tracking.uri is {uri!r}, but there is no {database}; give the one that the run is in")
        uri = f"{SQLITE_PREFIX}{database}"
    with usable_store(uri):
        client = MlflowClient(tracking_uri=uri)
        client.search_experiments(max_results=1)
        return client


def _check_texts(**values: object) -> None:
    for name, value in values.items():
        if not isinstance(value, str) or not value.strip() or value == SQLITE_PREFIX:
            raise TrackingError(f"tracking.{name} is {value!r}, but it must be a text such as {EXAMPLES[name]!r}")


@contextmanager
def usable_store(uri: str) -> Iterator[None]:
    """What a store is used in: it answers in time and quietly, and what goes wrong is a `TrackingError` of one line."""
    for name, value in HTTP_DEFAULTS.items():
        os.environ.setdefault(name, value)
    # The making of a new database is told table by table.
    for library in ("alembic", "mlflow"):
        logging.getLogger(library).setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            # SQLAlchemy tells MLflow's users of MLflow's own deprecated calls.
            warnings.simplefilter("ignore")
            yield
    except (MlflowException, SQLAlchemyError, OSError, ModuleNotFoundError) as error:
        reason = " ".join(str(error).split())[:300]
        raise TrackingError(f"tracking.uri is {uri!r}, but this store cannot be used: {reason}") from error


def _open_locked(uri: str, experiment: str, artifacts: str) -> tuple[MlflowClient, str]:
    if not uri.startswith(SQLITE_PREFIX):
        return _open(uri, experiment, None if uri.startswith("http") else artifacts)
    # Processes that create the tables of a fresh SQLite file at once can leave it unusable.
    database = Path(uri.removeprefix(SQLITE_PREFIX)).absolute()
    database.parent.mkdir(parents=True, exist_ok=True)
    # MLflow would try for minutes to open what cannot be opened, and the lock for ever to be made.
    database.open("ab").close()
    with FileLock(f"{database}.lock", timeout=LOCK_TIMEOUT_S):
        return _open(f"{SQLITE_PREFIX}{database}", experiment, artifacts)


def _open(uri: str, experiment: str, artifacts: str | None) -> tuple[MlflowClient, str]:
    client = MlflowClient(tracking_uri=uri)
    found = client.get_experiment_by_name(experiment)
    if found is not None:
        if found.lifecycle_stage != "active":
            raise TrackingError(
                f"tracking.experiment is {experiment!r}, but it was deleted; restore it, or name another"
            )
        return client, found.experiment_id
    location = Path(artifacts).absolute().as_uri() if artifacts else None
    return client, client.create_experiment(experiment, artifact_location=location)

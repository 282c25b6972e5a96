"""Open and check the MLflow tracking store and its experiment."""

from __future__ import annotations

import contextlib
import logging
import os
import sqlite3
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from filelock import FileLock

from armscan.config.credentials import SERVER_PASSWORD, TRACKING_PASSWORD, database_url, read_password
from armscan.config.trust import check_artifact_address
from armscan.errors import TrackingError
from armscan.tracking.settings import TrackingSettings, check_uri
from armscan.tracking.tracking_store import TrackingStore, reason_in
from armscan.tracking.view import VIEW, VIEW_TAG
from armscan.utils.files import SQLITE_PREFIX, check_writable, create_database, nearest_existing, sqlite_file

LOCK_TIMEOUT_S = 120
# `wait_s` of a store that is opened without a configuration.
DEFAULT_WAIT_S = 120.0
# Report an unavailable server within seconds, not after minutes of retries.
DEFAULTS = {
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    # Nobody asked for it, and from a cluster it cannot be sent.
    "MLFLOW_DISABLE_TELEMETRY": "true",
    # Progress bars and addresses would only clutter a worker's log.
    "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}


def open_store(
    uri: str,
    *,
    experiment: str,
    artifacts: str,
    wait_s: float,
    system_metrics_s: float | None = None,
    policy: bool = True,
    retry_s: float | None = None,
) -> tuple[TrackingStore, str]:
    """Open a tracking store, and create the experiment if it does not exist yet.

    Args:
        uri: MLflow tracking URI, such as `sqlite:///mlruns.db` or the address of an MLflow server.
        experiment: Name of the experiment.
        artifacts: Folder of the artifacts if the store is a database; a server has its own place for them.
        wait_s: Seconds that a run waits for an unavailable store at its end, 0 or more.
        system_metrics_s: Seconds between two measurements of the machine while a run trains, above 0. Default: None, no
            measurements.
        policy: Whether runs store their policies; only checked here, with the rest of the section. Default: True.
        retry_s: Seconds to retry at other times, including the opening of the store. Default: None, no retries.

    Returns:
        The store, and the experiment's ID.

    Raises:
        TrackingError: If the store cannot be reached or used, or a name or address is invalid.
        InvalidValueError: If another setting is invalid.
    """
    section = {"uri": uri, "experiment": experiment, "artifacts": artifacts, "wait_s": wait_s}
    TrackingSettings.read("tracking", section | {"system_metrics_s": system_metrics_s, "policy": policy})
    connected = partial(_store, wait_s=wait_s, system_metrics_s=system_metrics_s, retry_s=retry_s)
    with store_errors(uri):
        if not uri.startswith(SQLITE_PREFIX):
            store = connected(uri)
            return store, _experiment_in(store, experiment, None if uri.startswith("http") else artifacts)
        # Processes that create the tables of a fresh SQLite file at once can leave it unusable.
        database = sqlite_file(uri)
        database.parent.mkdir(parents=True, exist_ok=True)
        # Fail now if the file cannot be created: MLflow would retry for minutes, and the lock would wait forever. Do
        # not open it: closing it would drop the locks of this process's connections, and other processes could write
        # at the same time, which destroys the database (https://sqlite.org/howtocorrupt.html, section 2.2).
        check_writable(database)
        with FileLock(f"{database}.lock", timeout=LOCK_TIMEOUT_S):
            create_database(database, _create_tables)
            store = connected(f"{SQLITE_PREFIX}{database}")
            return store, _experiment_in(store, experiment, artifacts)


def open_existing_store(uri: str) -> TrackingStore:
    """Open an existing tracking store without creating anything; raise `TrackingError` if there is none."""
    check_uri(uri)
    if uri.startswith(SQLITE_PREFIX):
        database = sqlite_file(uri)
        if not database.is_file():
            raise TrackingError(
                f"tracking.uri is {uri!r}, but there is no {database}: no run was tracked there; name another store"
            )
        _check_is_store(uri, database)
        uri = f"{SQLITE_PREFIX}{database}"
    with store_errors(uri):
        store = _store(uri, wait_s=DEFAULT_WAIT_S)
        store.search_experiments(max_results=1)
        return store


def _create_tables(database: Path) -> None:
    from mlflow.db import upgrade

    # Not as a command, which turns an interrupt into an error of its own.
    assert upgrade.callback is not None
    upgrade.callback(f"{SQLITE_PREFIX}{database}")


def _check_is_store(uri: str, database: Path) -> None:
    """Raise `TrackingError` if a database is not an MLflow store: MLflow would create its tables in it."""
    wanted = "SELECT count(*) FROM sqlite_master WHERE name IN ('alembic_version', 'experiments', 'runs')"
    try:
        with contextlib.closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True)) as connection:
            (n_found,) = connection.execute(wanted).fetchone()
    except sqlite3.Error as error:
        raise TrackingError(f"tracking.uri is {uri!r}, but this store cannot be used: {error}") from error
    if n_found < 3:
        raise TrackingError(
            f"tracking.uri is {uri!r}, but {database} is not an MLflow store: give the one with the runs"
        )


def _store(
    uri: str, *, wait_s: float, system_metrics_s: float | None = None, retry_s: float | None = None
) -> TrackingStore:
    """Return an open store; only its client gets the driver and the password of a database."""
    from mlflow import MlflowClient

    address = uri
    if uri.startswith("postgresql"):
        address = database_url(uri, TRACKING_PASSWORD).render_as_string(hide_password=False)
    connect = partial(MlflowClient, tracking_uri=address)
    return TrackingStore(connect, uri, wait_s=wait_s, system_metrics_s=system_metrics_s, retry_s=retry_s)


def absolute(uri: str) -> str:
    """Return the address of a store with an absolute path, which is valid in any working folder."""
    return f"{SQLITE_PREFIX}{sqlite_file(uri)}" if uri.startswith(SQLITE_PREFIX) else uri


@contextlib.contextmanager
def store_errors(uri: str) -> Iterator[None]:
    """Turn the errors of a store into a one-line `TrackingError`, with short timeouts and no warnings."""
    for name, value in DEFAULTS.items():
        os.environ.setdefault(name, value)
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    if SERVER_PASSWORD not in os.environ and (password := read_password(SERVER_PASSWORD)):
        os.environ[SERVER_PASSWORD] = password
    # They log each table of a new database.
    for library in ("alembic", "mlflow"):
        logging.getLogger(library).setLevel(logging.WARNING)
    # They log errors of an unavailable store that are raised as well.
    for library in ("mlflow.store.db.utils", "urllib3.connectionpool"):
        logging.getLogger(library).setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            # SQLAlchemy warns about deprecated calls that MLflow makes.
            warnings.simplefilter("ignore")
            yield
    # Not the store's: the reader of this process's output, such as `head`, has ended.
    except BrokenPipeError:
        raise
    except (MlflowException, SQLAlchemyError, OSError, ModuleNotFoundError) as error:
        raise TrackingError(f"tracking.uri is {uri!r}, but this store cannot be used: {reason_in(error)}") from error


def _experiment_in(store: TrackingStore, name: str, artifacts: str | None) -> str:
    """Return the ID of an experiment; create it if there is none."""
    from mlflow.exceptions import MlflowException

    location = Path(artifacts).absolute().as_uri() if artifacts else None
    found = store.get_experiment_by_name(name)
    if found is None:
        _check_writable(location)
        try:
            store.create_experiment(name, artifact_location=location)
        except MlflowException as error:
            # Another process has just created it, or this one has, and only the reply was lost.
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise
        found = store.get_experiment_by_name(name)
    if found.lifecycle_stage != "active":
        raise TrackingError(f"tracking.experiment is {name!r}, but it was deleted; restore it, or name another")
    _check_artifacts_in(found.artifact_location, store.uri)
    experiment_id = str(found.experiment_id)
    # The saved view of runs: there is none yet, or another version's.
    if found.tags.get(VIEW_TAG) != VIEW:
        store.set_experiment_tag(experiment_id, VIEW_TAG, VIEW)
    return experiment_id


def check_artifacts(store: TrackingStore, experiment_id: str) -> None:
    """Raise `TrackingError` if the artifacts of an experiment cannot be written, or are on another server."""
    _check_artifacts_in(store.get_experiment(experiment_id).artifact_location, store.uri)


def _check_artifacts_in(location: str, uri: str) -> None:
    check_artifact_address(location, uri)
    _check_writable(location)


def _check_writable(location: str | None) -> None:
    """Raise `TrackingError` if the artifacts are stored in a folder of this machine that cannot be written."""
    # A server is only checked by the first upload; files that it refuses stay in the folder of the run.
    if location is None or not location.startswith("file:"):
        return
    folder = Path(url2pathname(urlsplit(location).path))
    try:
        # Create nothing, so that a later error leaves nothing behind.
        check_writable(nearest_existing(folder) / "any")
    except OSError as error:
        raise TrackingError(
            f"the artifacts of runs lie in {folder}, as their experiment or tracking.artifacts says, but no file can "
            f"be written there: {error.strerror}"
        ) from error

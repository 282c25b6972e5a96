"""`armscan ui`: find studies and runs, and show them in the browser."""

from __future__ import annotations

import sys
import time
import urllib.error
import urllib.request
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path

from armscan.config.credentials import TRACKING_PASSWORD, check_address, database_url
from armscan.errors import InvalidValueError, ServerError, TrackingError
from armscan.ui.servers import POLL_S, Server, running
from armscan.utils.files import SQLITE_PREFIX, sqlite_file

# One of the tables of MLflow.
RUNS_TABLE = "experiments"
ANSWER_S, MAX_REASON_CHARS = 5.0, 300


@dataclass(frozen=True, kw_only=True)
class Store:
    """A store of studies or runs.

    Args:
        option: command-line option that names it.
        contents: `studies` or `runs`.
        uri: its address.
        exists: whether there is anything in it.
        server: shows it; None for an MLflow server, which has a UI of its own.
    """

    option: str
    contents: str
    uri: str
    exists: bool
    server: Server | None

    @property
    def missing(self) -> str:
        """What is wrong with a store that does not exist."""
        return f"there are no {self.contents} there" if self.server else "no server answers there"


def show(
    *,
    storage: str,
    tracking: str,
    artifacts: Path,
    mlflow_port: int,
    dashboard_port: int,
    named: Collection[str] = (),
) -> int:
    """Show studies and runs until Ctrl-C.

    Args:
        storage: Optuna storage of the studies.
        tracking: MLflow tracking store of the runs.
        artifacts: folder of the plots that the dashboard shows.
        mlflow_port: port of MLflow's UI.
        dashboard_port: port of Optuna's dashboard.
        named: options that were given on the command line, `--storage` or `--tracking`; these stores must exist.

    Returns:
        The exit code: 0 if only an MLflow server has anything to show, 1 if a server has ended by itself.

    Raises:
        InvalidValueError: if there is nothing to show, or a port is taken.
        StudyError: if the storage cannot be used.
        TrackingError: if the tracking store cannot be used.
    """
    stores = [find_studies(storage, artifacts, dashboard_port), find_runs(tracking, mlflow_port)]
    for store in stores:
        if not store.exists and store.option in named:
            raise InvalidValueError(f"{store.option} is {store.uri!r}, but {store.missing}")
    if not any(store.exists for store in stores):
        nowhere = " and ".join(f"no {store.contents} in {store.uri!r}" for store in stores)
        raise InvalidValueError(f"there is nothing to look at, {nowhere}: give --storage URI or --tracking URI")
    servers = [store.server for store in stores if store.exists and store.server is not None]
    for server in servers:
        server.check_port()
    for store in stores:
        if not store.exists:
            print(f"note: there are no {store.contents} in {store.uri!r} yet; {store.option} URI names others")
        elif store.server is None:
            print(f"{store.contents:<10}{store.uri}")
    return _serve(servers) if servers else 0


def is_server(tracking: str) -> bool:
    """Whether a tracking store is an MLflow server."""
    return tracking.startswith(("http://", "https://"))


def find_studies(storage: str, artifacts: Path, port: int) -> Store:
    """Return the store of the studies, without making one.

    Raises:
        StudyError: if the storage cannot be used.
    """
    # Deferred: a mistake on the command line should be answered before this is loaded.
    from armscan.sweeps.storage.storage import existing_storage

    exists = existing_storage(storage, where="--storage") is not None
    server = Server(
        title="Optuna's dashboard",
        program="dashboard",
        arguments=(storage, str(artifacts)),
        option="--dashboard-port",
        port=port,
    )
    return Store(option="--storage", contents="studies", uri=storage, exists=exists, server=server)


def find_runs(tracking: str, port: int) -> Store:
    """Return the store of the runs, without making one.

    Raises:
        TrackingError: if the tracking store cannot be used.
    """
    check_address("--tracking", tracking)
    if is_server(tracking):
        uri = tracking.rstrip("/")
        return Store(option="--tracking", contents="runs", uri=uri, exists=_is_answering(f"{uri}/health"), server=None)
    exists = _has_runs(tracking)
    server = Server(title="MLflow", program="mlflow", arguments=(tracking,), option="--mlflow-port", port=port)
    return Store(option="--tracking", contents="runs", uri=tracking, exists=exists, server=server)


def _is_answering(address: str) -> bool:
    """Whether a server answers, if only with a refusal."""
    try:
        urllib.request.urlopen(address, timeout=ANSWER_S).close()
    except urllib.error.HTTPError as error:
        return error.code < 500
    except (OSError, HTTPException, ValueError):
        return False
    return True


def _has_runs(uri: str) -> bool:
    """Whether a database has the tables of MLflow, which would create them."""
    from sqlalchemy.exc import SQLAlchemyError

    from armscan.sweeps.storage.database import tables_in

    if not uri.startswith((SQLITE_PREFIX, "postgresql")):
        raise TrackingError(
            f"--tracking is {uri!r}, but it must be sqlite:///FILE, postgresql://... or an MLflow server's address"
        )
    if uri.startswith(SQLITE_PREFIX) and not sqlite_file(uri).is_file():
        return False
    try:
        return RUNS_TABLE in tables_in(database_url(uri, TRACKING_PASSWORD))
    except (SQLAlchemyError, ImportError, OSError, ValueError) as error:
        # The reason, without the statement that failed.
        reason = " ".join(str(getattr(error, "orig", None) or error).split())[:MAX_REASON_CHARS]
        raise TrackingError(f"--tracking is {uri!r}, but this store cannot be used: {reason}") from error


def _serve(servers: Sequence[Server]) -> int:
    """Run servers until Ctrl-C, or until one of them ends; return the exit code."""
    try:
        with running(servers) as processes:
            for process in processes:
                process.wait_until_answering(processes)
                hint = "   under Model training, at its top left" if process.server.program == "mlflow" else ""
                print(f"{'runs' if hint else 'studies':<10}{process.server.address}{hint}", flush=True)
            print(f"Ctrl-C ends {'both' if len(processes) > 1 else 'it'}", flush=True)
            while True:
                for process in processes:
                    process.check()
                time.sleep(POLL_S)
    except ServerError as error:
        print(f"error: {error}; the end of its log:\n{error.log}", file=sys.stderr)
    return 1

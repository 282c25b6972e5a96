"""`armscan ui`: find studies and runs, and show them in the browser."""

from __future__ import annotations

import threading
from collections.abc import Collection
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

from armscan.config.credentials import TRACKING_PASSWORD, database_url
from armscan.errors import InvalidValueError, TrackingError, printable, reason_of
from armscan.ui.servers import HOST, check_port, mlflow_server, start_dashboard
from armscan.utils.files import SQLITE_PREFIX, sqlite_file

if TYPE_CHECKING:
    from armscan.sweeps.storage.storage import Storage

# One of the tables of MLflow.
MLFLOW_TABLE = "experiments"


def show(
    *,
    storage: str,
    tracking: str,
    artifacts: Path,
    mlflow_port: int,
    dashboard_port: int,
    named: Collection[str] = (),
) -> None:
    """Show studies and runs until Ctrl-C; return at once if only an MLflow server has something to show.

    Args:
        storage: Optuna storage of the studies.
        tracking: MLflow tracking store of the runs.
        artifacts: Folder of the plots that the dashboard shows.
        mlflow_port: Port of MLflow's UI, from 1 to 65,535.
        dashboard_port: Port of Optuna's dashboard, likewise.
        named: Options given on the command line, `--storage` or `--tracking`; these stores must exist.

    Raises:
        InvalidValueError: If there is nothing to show, a named store does not exist, or a port cannot be used.
    """
    # Deferred: a mistake on the command line should be reported before this is loaded.
    from armscan.sweeps.storage.storage import existing_storage

    studies, is_server = existing_storage(storage, where="--storage"), tracking.startswith("http")
    has_runs = not is_server and _has_runs(tracking)
    missing = [("--storage", "studies", storage)] if studies is None else []
    missing += [] if has_runs or is_server else [("--tracking", "runs", tracking)]
    for option, contents, uri in missing:
        if option in named:
            raise InvalidValueError(f"{option} is {uri!r}, but there are no {contents} there")
    if len(missing) == 2:
        nowhere = " and ".join(f"no {contents} in {uri!r}" for _, contents, uri in missing)
        raise InvalidValueError(f"there is nothing to look at, {nowhere}: give --storage URI or --tracking URI")
    if studies is not None:
        check_port("--dashboard-port", dashboard_port)
    if has_runs:
        check_port("--mlflow-port", mlflow_port)
    for option, contents, uri in missing:
        print(f"note: there are no {contents} in {uri!r} yet; {option} URI names others")
    servers = [name for name, is_there in (("Optuna's dashboard", studies), ("MLflow's UI", has_runs)) if is_there]
    if servers:
        print(f"starting  {' and '.join(servers)}, which takes some seconds", flush=True)
    if is_server:
        print(f"runs      {tracking}")
    if studies is not None:
        runs_at = f"http://{HOST}:{mlflow_port}" if has_runs else None
        dashboard = start_dashboard(studies, artifacts, dashboard_port, mlflow=runs_at)
        print(f"studies   {dashboard}", flush=True)
        if (tested := newest_tested(studies)) is not None:
            name, number = tested
            print(f"result    {dashboard}/dashboard/studies/{number}/note (study {printable(name)})", flush=True)
    if has_runs:
        with mlflow_server(tracking, mlflow_port) as process:
            # Deferred: it imports the tracking package.
            from armscan.ui.runs_page import runs_page

            print(f"runs      {runs_page(f'http://{HOST}:{mlflow_port}')}")
            print(f"Ctrl-C ends {'both' if studies is not None else 'it'}", flush=True)
            process.wait()
    elif studies is not None:
        print("Ctrl-C ends it", flush=True)
        threading.Event().wait()


def newest_tested(storage: Storage) -> tuple[str, int] | None:
    """Return the name and the ID of the newest study with a result; None if there is none."""
    # Deferred, as above.
    from optuna.trial import TrialState

    from armscan.sweeps.storage.attributes import TEST_SUFFIX

    def is_tested(name: str) -> bool:
        test = storage.study(f"{name}{TEST_SUFFIX}")
        return test is not None and bool(test.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))

    numbers = {study.study_name: study._study_id for study in storage.optuna.get_all_studies()}
    tested = filter(is_tested, numbers)
    return max(((name, numbers[name]) for name in tested), key=itemgetter(1), default=None)


def _has_runs(uri: str) -> bool:
    """Return whether a database has the tables of MLflow, which would create them itself."""
    from sqlalchemy.exc import SQLAlchemyError

    from armscan.sweeps.storage.database import tables_in

    if not uri.startswith((SQLITE_PREFIX, "postgresql")):
        raise TrackingError(
            f"--tracking is {uri!r}, but it must be sqlite:///FILE, postgresql://... or an MLflow server's address"
        )
    if uri.startswith(SQLITE_PREFIX) and not sqlite_file(uri).is_file():
        return False
    try:
        return MLFLOW_TABLE in tables_in(database_url(uri, TRACKING_PASSWORD))
    except (SQLAlchemyError, ImportError, OSError, ValueError) as error:
        # The reason, without the statement that failed.
        reason = reason_of(getattr(error, "orig", None) or error)
        raise TrackingError(f"--tracking is {uri!r}, but this store cannot be used: {reason}") from error

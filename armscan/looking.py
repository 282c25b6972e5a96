"""What `python -m armscan.ui` has to show: where studies and runs are, whether any are there, and what shows them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote, urlsplit

from armscan.errors import TrackingError
from armscan.files import SQLITE_PREFIX, sqlite_file
from armscan.passwords import STORAGE_PASSWORD, TRACKING_PASSWORD, database_url, without_password
from armscan.servers import HOST, Server, is_answered

# Where the notes of trials say that MLflow's UI is (`armscan.sweeps.dashboard`), where runs are kept by no server.
USUAL_UI = f"http://{HOST}:5000"
# Of the tables of MLflow.
A_TABLE = "experiments"
MAX_REASON_CHARS = 300


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is to be looked at.

    Args:
        storage: of the studies.
        tracking: of the runs.
        artifacts: folder of the pictures.
        mlflow_port: of MLflow's UI.
        dashboard_port: of Optuna's dashboard.
        named: the keys that were given.
    """

    storage: str = field(repr=False)
    tracking: str = field(repr=False)
    artifacts: Path
    mlflow_port: int
    dashboard_port: int
    named: frozenset[str]

    @property
    def has_tracking_server(self) -> bool:
        """Whether the runs are kept by a server, which has a UI of its own."""
        return self.tracking.startswith(("http://", "https://"))


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where studies or runs are kept.

    Args:
        key: that names it on the command line.
        what: is kept there.
        shown: its address, as it may be shown.
        is_there: whether there is anything.
        server: that shows it, None where it is shown already.
    """

    key: str
    what: str
    shown: str
    is_there: bool
    server: Server | None


def place_of_studies(request: Request) -> Place:
    """Returns where the studies are.

    Raises:
        StudyError: if the storage cannot be reached or used.
    """
    # Deferred: a mistake on the command line should be answered before these are loaded.
    from armscan.sweeps.storage import existing_storage, is_journal

    is_there = existing_storage(request.storage, where="storage") is not None
    ui = f"http://{HOST}:{request.mlflow_port}"
    server = Server(
        program="studies",
        title="Optuna's dashboard",
        port_key="dashboard_port",
        port=request.dashboard_port,
        health="/api/meta",
        told={
            "storage": request.storage,
            "artifacts": str(request.artifacts),
            "links": {} if ui == USUAL_UI else {USUAL_UI: ui},
        },
        secrets=() if is_journal(request.storage) else _secrets_of(request.storage, STORAGE_PASSWORD),
    )
    return Place(
        key="storage", what="studies", shown=without_password(request.storage), is_there=is_there, server=server
    )


def place_of_runs(request: Request) -> Place:
    """Returns where the runs are.

    Raises:
        TrackingError: if no runs can be there, or it cannot be reached.
    """
    if request.has_tracking_server:
        try:
            parts = urlsplit(request.tracking)
            address = parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl().rstrip("/")
        except ValueError as error:
            shown = without_password(request.tracking)
            raise TrackingError(f"tracking is {shown!r}, but that is no address of a server: {error}") from error
        return Place(key="tracking", what="runs", shown=address, is_there=is_answered(f"{address}/health"), server=None)
    shown, is_there = without_password(request.tracking), _has_runs(request.tracking)
    server = Server(
        program="runs",
        title="MLflow",
        port_key="mlflow_port",
        port=request.mlflow_port,
        health="/health",
        told={"store": database_url(request.tracking, TRACKING_PASSWORD).render_as_string(hide_password=False)},
        secrets=_secrets_of(request.tracking, TRACKING_PASSWORD),
        hint="   under Model training, at its top left",
    )
    return Place(key="tracking", what="runs", shown=shown, is_there=is_there, server=server)


def _has_runs(uri: str) -> bool:
    """Whether a database has the tables of MLflow, which would make them where there are none."""
    from sqlalchemy.exc import SQLAlchemyError

    from armscan.sweeps.database import tables_in

    shown = without_password(uri)
    if not uri.startswith((SQLITE_PREFIX, "postgresql")):
        raise TrackingError(
            f"tracking is {shown!r}, but it must be sqlite:///FILE, postgresql://... or the address of an MLflow server"
        )
    if uri.startswith(SQLITE_PREFIX) and not sqlite_file(uri).is_file():
        return False
    try:
        return A_TABLE in tables_in(database_url(uri, TRACKING_PASSWORD))
    except (SQLAlchemyError, ImportError, OSError, ValueError) as error:
        # Of a statement that has failed: why, but not the statement.
        reason = " ".join(str(getattr(error, "orig", None) or error).split()).replace(uri, shown)[:MAX_REASON_CHARS]
        raise TrackingError(f"tracking is {shown!r}, but this store cannot be used: {reason}") from error


def _secrets_of(uri: str, variable: str) -> tuple[str, ...]:
    """Returns what must not be shown of a database: its password, as it is and as it is written in an address."""
    password = database_url(uri, variable).password
    return (password, quote(password, safe=" +")) if password else ()

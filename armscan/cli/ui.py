"""`armscan ui`: MLflow's UI and Optuna's dashboard, for this machine alone."""

from __future__ import annotations

from pathlib import Path

import click

from armscan.cli.options import Command, FilePath, is_given, storage_option, tracking_option
from armscan.config.services import DASHBOARD_PORT, MLFLOW_PORT
from armscan.errors import InvalidValueError

PORT = click.IntRange(1, 65_535)


@click.command(
    cls=Command,
    left="nothing is left running",
    examples=["ui --storage postgresql://USER@HOST/DATABASE --tracking http://SERVER:5000"],
)
@storage_option("Optuna storage of the studies; the password of a database is read from ARMSCAN_STORAGE_PASSWORD.")
@tracking_option("MLflow tracking store of the runs; the password of a database: ARMSCAN_TRACKING_PASSWORD.")
@click.option("--artifacts", type=FilePath("FOLDER"), default="optuna.artifacts", help="Plots shown in the dashboard.")
@click.option(
    "--mlflow-port", type=PORT, default=MLFLOW_PORT, help="Port of MLflow's UI; links of trials lead to 5000."
)
@click.option("--dashboard-port", type=PORT, default=DASHBOARD_PORT, help="Port of Optuna's dashboard.")
def ui(storage: str, tracking: str, artifacts: Path, mlflow_port: int, dashboard_port: int) -> int:
    """Serve MLflow's UI and Optuna's dashboard.

    Both are for this machine alone, until Ctrl-C.

    A store that is named must exist; of the default ones, one may still be empty. An MLflow server has a UI of its own,
    which is only named.
    """
    # Deferred: `--help` needs none of it.
    from armscan.ui.show import is_server, show

    if mlflow_port == dashboard_port:
        raise click.UsageError(f"--mlflow-port and --dashboard-port are both {mlflow_port}, but each must have its own")
    if is_server(tracking) and is_given("mlflow_port"):
        raise click.UsageError(
            f"--mlflow-port is {mlflow_port}, but the runs are kept by a server, which has a UI of its own"
        )
    if is_given("artifacts") and not artifacts.is_dir():
        raise InvalidValueError(f"--artifacts is {str(artifacts)!r}, but there is no such folder")
    return show(
        storage=storage,
        tracking=tracking,
        artifacts=artifacts,
        mlflow_port=mlflow_port,
        dashboard_port=dashboard_port,
        named=[f"--{name}" for name in ("storage", "tracking") if is_given(name)],
    )

"""`armscan ui`: MLflow's UI and Optuna's dashboard, for this machine alone."""

from __future__ import annotations

from pathlib import Path

import click

from armscan.cli.options import FILE_PATH, examples, is_given, storage_option, tracking_option
from armscan.config.services import DASHBOARD_PORT, MLFLOW_PORT

PORT = click.IntRange(1, 65_535)


@click.command(epilog=examples("ui --storage postgresql://USER@HOST/DATABASE --tracking http://SERVER:5000"))
@storage_option(help="Optuna storage of the studies; the password of a database is read from ARMSCAN_STORAGE_PASSWORD.")
@tracking_option(help="MLflow tracking store of the runs; the password of a database: ARMSCAN_TRACKING_PASSWORD.")
@click.option(
    "--artifacts", type=FILE_PATH, metavar="FOLDER", default="optuna.artifacts", help="Plots shown in the dashboard."
)
@click.option("--mlflow-port", type=PORT, default=MLFLOW_PORT, help="Port of MLflow's UI.")
@click.option("--dashboard-port", type=PORT, default=DASHBOARD_PORT, help="Port of Optuna's dashboard.")
def ui(storage: str, tracking: str, artifacts: Path, mlflow_port: int, dashboard_port: int) -> None:
    """Serve MLflow's UI and Optuna's dashboard.

    Both accept connections from this machine only, and run until Ctrl-C.

    A store given by an option must exist; one of the two default stores may be missing. An MLflow server has its own
    UI: only its address is printed.
    """
    # Deferred: `--help` needs none of it.
    from armscan.ui.show import show

    show(
        storage=storage,
        tracking=tracking,
        artifacts=artifacts,
        mlflow_port=mlflow_port,
        dashboard_port=dashboard_port,
        named=[f"--{name}" for name in ("storage", "tracking") if is_given(name)],
    )

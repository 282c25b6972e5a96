"""Local servers for a browser: Optuna's dashboard in a thread, MLflow's UI in a process."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from socketserver import ThreadingMixIn
from threading import Thread
from typing import IO, TYPE_CHECKING
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from armscan.config.credentials import TRACKING_PASSWORD, database_url, mask_passwords
from armscan.errors import InvalidValueError, TrackingError
from armscan.ui.dashboard_view import DashboardView
from armscan.ui.host_check import HostCheck
from armscan.utils.processes import child_command, on_parent_exit

if TYPE_CHECKING:
    from armscan.sweeps.storage.storage import Storage

HOST = "127.0.0.1"
START_S, END_S, POLL_S = 120.0, 5.0, 0.1
LOG_BYTES = 2000
MLFLOW_OPTIONS = ("--host", HOST, "--workers", "1", "--uvicorn-opts=--no-access-log")


class _Threaded(ThreadingMixIn, WSGIServer):
    daemon_threads = True


class _Quiet(WSGIRequestHandler):
    def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
        """Log errors only."""


def check_port(option: str, port: int) -> None:
    """Raise `InvalidValueError` unless a local server can listen on a port, which `option` sets."""
    try:
        socket.create_server((HOST, port)).close()
    except OSError as error:
        reason = os.strerror(error.errno or 0).lower()
        raise InvalidValueError(f"{option} is {port}, but {HOST}:{port} cannot be used ({reason})") from error


def start_dashboard(
    storage: Storage,
    artifacts: Path,
    port: int,
    *,
    host: str = HOST,
    allowed_hosts: Sequence[str] = (),
    mlflow: str | None = None,
) -> str:
    """Serve Optuna's dashboard for the rest of this process; return its address.

    Optuna's own command would open a journal without the lock that workers use.

    Args:
        storage: Storage of the studies.
        artifacts: Folder of the plots that it shows.
        port: Port to listen on.
        host: Address to listen on. Default: the loopback address.
        allowed_hosts: Names and ports, `NAME:PORT`, by which browsers may reach it; `*` matches any text.
            Default: `127.0.0.1` and `localhost` with the port.
        mlflow: Address of MLflow's UI for the links in notes. Default: None, the links stay as they are.
    """
    from optuna.artifacts import FileSystemArtifactStore
    from optuna_dashboard import wsgi

    from armscan.sweeps.stop import stop_running_trial

    storage.optuna.checks_reads = False
    application = wsgi(storage.optuna, artifact_store=FileSystemArtifactStore(artifacts))
    view = DashboardView(application, partial(stop_running_trial, storage), mlflow)
    checked = HostCheck(view, allowed_hosts or (f"{HOST}:{port}", f"localhost:{port}"))
    server = make_server(host, port, checked, server_class=_Threaded, handler_class=_Quiet)
    Thread(target=server.serve_forever, daemon=True).start()
    return f"http://{host}:{port}"


@contextlib.contextmanager
def mlflow_server(uri: str, port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Serve MLflow's UI inside the context, which begins once the server answers.

    Raises:
        TrackingError: If the server does not answer in time, or ends by itself; the end of its log is printed.
    """
    store = database_url(uri, TRACKING_PASSWORD).render_as_string(hide_password=False)
    # In the environment, because anyone can read a process's command line. Without job execution MLflow starts eight
    # processes fewer.
    environment = os.environ | {"MLFLOW_BACKEND_STORE_URI": store, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    environment.pop("MLFLOW_TRACKING_URI", None)
    command = [*child_command(__name__, serve_mlflow.__name__), "server", *MLFLOW_OPTIONS, "--port", str(port)]
    with tempfile.TemporaryFile() as log:
        # In a process group of its own, which a Ctrl-C does not reach.
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)
        try:
            until_s = time.monotonic() + START_S
            while process.poll() is None and not _is_answering(port):
                if time.monotonic() > until_s:
                    raise _failed(log, f"does not answer within {START_S:g} s of its start")
                time.sleep(POLL_S)
            if process.poll() is None:
                yield process
            if process.poll() is not None:
                raise _failed(log, f"has ended by itself, with exit code {process.returncode}")
        finally:
            with contextlib.suppress(ProcessLookupError, subprocess.TimeoutExpired):
                os.killpg(process.pid, signal.SIGTERM)
                process.wait(END_S)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def serve_mlflow(parent_pid: int) -> None:
    """Run MLflow's command with the arguments of this process, which ends with its parent.

    Args:
        parent_pid: Process ID of the parent.
    """

    def end_group() -> None:
        os.killpg(0, signal.SIGTERM)
        time.sleep(END_S)
        os.killpg(0, signal.SIGKILL)

    on_parent_exit(parent_pid, end_group)
    from mlflow.cli import cli

    cli()


def _is_answering(port: int) -> bool:
    try:
        socket.create_connection((HOST, port), timeout=POLL_S).close()
    except OSError:
        return False
    return True


def _failed(log: IO[bytes], what: str) -> TrackingError:
    log.seek(max(0, log.seek(0, os.SEEK_END) - LOG_BYTES))
    print(mask_passwords(log.read().decode(errors="replace")).strip(), file=sys.stderr)
    return TrackingError(f"MLflow {what}; the end of its log is above")

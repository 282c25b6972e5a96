"""Child process of `armscan ui`: MLflow's UI or Optuna's dashboard on 127.0.0.1, until its standard input is closed.

python -m armscan.ui.serve mlflow PORT URI
python -m armscan.ui.serve dashboard PORT URI ARTIFACTS
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from socketserver import ThreadingMixIn
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from armscan.config.credentials import TRACKING_PASSWORD, database_url
from armscan.errors import ArmscanError, StudyError
from armscan.ui.servers import END_S, HOST


def serve_mlflow(port: str, uri: str) -> None:
    """Serve MLflow's UI of a database with runs."""
    store = database_url(uri, TRACKING_PASSWORD).render_as_string(hide_password=False)
    # In the environment, because anyone can read the command line of a process. Without jobs: eight processes fewer.
    os.environ |= {"MLFLOW_BACKEND_STORE_URI": store, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    from mlflow.cli import cli

    cli(["server", "--host", HOST, "--port", port, "--workers", "1", "--uvicorn-opts=--no-access-log"])


def serve_dashboard(port: str, uri: str, artifacts: str) -> None:
    """Serve Optuna's dashboard. Its own program would open a journal without the lock that workers use."""
    from optuna.artifacts import FileSystemArtifactStore
    from optuna_dashboard import wsgi

    from armscan.sweeps.storage.storage import existing_storage

    storage = existing_storage(uri, where="--storage")
    if storage is None:
        raise StudyError(f"--storage is {uri!r}, but it has been deleted")
    application = wsgi(storage.optuna, artifact_store=FileSystemArtifactStore(artifacts))
    with make_server(HOST, int(port), application, server_class=_Threaded, handler_class=_Quiet) as server:
        server.serve_forever()


class _Threaded(ThreadingMixIn, WSGIServer):
    daemon_threads = True


class _Quiet(WSGIRequestHandler):
    def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
        """Log errors only."""


def main() -> int:
    """Serve until the parent process closes standard input, or is gone; return the exit code."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    program, *arguments = sys.argv[1:]
    try:
        (serve_mlflow if program == "mlflow" else serve_dashboard)(*arguments)
    except ArmscanError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _end_with_parent() -> None:
    """End this process and its children, which are a process group, at the end of standard input."""
    # Not by sys.stdin, whose lock this thread would hold when the interpreter ends.
    os.read(0, 1)
    os.killpg(0, signal.SIGTERM)
    time.sleep(END_S)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())

"""What runs in the processes of `armscan.servers`: MLflow's UI and Optuna's dashboard, for this machine alone.

An address may hold a password, and everybody can read the command line of a process: so a server is told on its
standard input what it serves.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from armscan.errors import ArmscanError, StudyError
from armscan.passwords import without_password
from armscan.servers import END_S, HOST

Application = Callable[[dict[str, Any], Callable[..., Any]], Iterable[bytes]]


def serve_runs(*, store: str, port: int) -> None:
    """Runs MLflow's UI.

    Args:
        store: address of the database of the runs, as SQLAlchemy has it.
        port: to answer on.
    """
    # A server that nobody sends jobs to needs no processes for them; and nobody is told that somebody looks.
    os.environ |= {"MLFLOW_BACKEND_STORE_URI": store, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    from mlflow.cli import cli

    cli(["server", "--host", HOST, "--port", str(port), "--workers", "1", "--uvicorn-opts=--no-access-log"])


def serve_studies(*, storage: str, artifacts: str, links: Mapping[str, str], port: int) -> None:
    """Runs Optuna's dashboard.

    Args:
        storage: of the studies.
        artifacts: folder of the pictures.
        links: what the notes of trials lead to, and what they shall lead to.
        port: to answer on.
    """
    from optuna.artifacts import FileSystemArtifactStore
    from optuna_dashboard import wsgi

    from armscan.sweeps.storage import existing_storage

    opened = existing_storage(storage, where="storage")
    if opened is None:
        raise StudyError(f"storage is {without_password(storage)!r}, but nothing is there any more")
    application: Application = wsgi(opened.optuna, artifact_store=FileSystemArtifactStore(artifacts))
    with make_server(
        HOST, port, with_links(application, links), server_class=_Threaded, handler_class=_Quiet
    ) as server:
        server.serve_forever()


class _Threaded(ThreadingMixIn, WSGIServer):
    daemon_threads = True


class _Quiet(WSGIRequestHandler):
    def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
        """Keeps requests out of the log, which nobody would ever cut off; errors still go there."""


def with_links(application: Application, links: Mapping[str, str]) -> Application:
    """Returns a WSGI application whose JSON leads elsewhere.

    Args:
        application: with JSON below `/api/`.
        links: addresses, and those to be read in their place.
    """

    def answer(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        if not environ["PATH_INFO"].startswith("/api/"):
            return application(environ, start_response)

        def start(status: str, headers: list[tuple[str, str]], *rest: Any) -> Any:
            return start_response(status, [each for each in headers if each[0].lower() != "content-length"], *rest)

        body = b"".join(application(environ, start))
        for address, other in links.items():
            body = body.replace(address.encode(), other.encode())
        return [body]

    return answer


PROGRAMS: dict[str, Callable[..., None]] = {"runs": serve_runs, "studies": serve_studies}


def main() -> int:
    """Serves what is asked for on standard input; returns the exit code."""
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_leave_with_starter, daemon=True).start()
    try:
        PROGRAMS[sys.argv[1]](**request)
    except ArmscanError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _leave_with_starter() -> None:
    """Ends this process and those that it has started when nobody holds the other end of standard input any more."""
    while os.read(0, 1):
        pass
    os.killpg(0, signal.SIGTERM)
    time.sleep(END_S)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())

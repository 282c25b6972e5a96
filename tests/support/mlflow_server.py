"""A private MLflow server for tests and benchmarks, on a free port of this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.ports import LOOPBACK, free_port
from tests.support.waiting import wait_until

STOP_S = 10.0


@contextmanager
def mlflow_server(folder: Path, backend: str, host: str = LOOPBACK) -> Iterator[MlflowServer]:
    """Start a server; stop it at the end of the block."""
    server = MlflowServer(folder, backend, host)
    server.start()
    try:
        yield server
    finally:
        server.stop()


class MlflowServer:
    """A tracking server that serves the artifacts, too.

    Args:
        folder: Folder of its artifacts and its log.
        backend: Address of its database.
        host: Address that it listens on.
    """

    def __init__(self, folder: Path, backend: str, host: str = LOOPBACK) -> None:
        self._folder, self._host = folder, host
        self.artifacts, self.log = folder / "artifacts", folder / "mlflow_server.log"
        # The driver that armscan installs.
        uri = backend.replace("postgresql://", "postgresql+psycopg://")
        self._environment = os.environ | {
            "MLFLOW_BACKEND_STORE_URI": uri,
            "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
        }
        self._environment.pop("MLFLOW_TRACKING_URI", None)
        self._process: subprocess.Popen[bytes] | None = None
        self.port = free_port(host)

    @property
    def uri(self) -> str:
        """Its address."""
        return f"http://{self._host}:{self.port}"

    def start(self) -> None:
        """Start it, and wait until it answers."""
        self._folder.mkdir(parents=True, exist_ok=True)
        words = ["server", "--host", self._host, "--port", str(self.port), "--workers", "1"]
        words += ["--artifacts-destination", str(self.artifacts)]
        with self.log.open("ab") as log:
            # In its own process group, so that its child processes are ended, too.
            self._process = subprocess.Popen(
                [Path(sys.executable).with_name("mlflow"), *words],
                cwd=self._folder,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        wait_until(lambda: is_answered(f"{self.uri}/health"), process=self._process, log=self.log.read_text, poll_s=0.1)

    def stop(self) -> None:
        """Stop it, and wait until its processes are gone."""
        if self._process is None:
            return
        os.killpg(self._process.pid, signal.SIGTERM)
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._process = None


def is_answered(url: str) -> bool:
    """Return whether a server answers a request with status 200."""
    try:
        with urllib.request.urlopen(url, timeout=5) as answer:
            return bool(answer.status == 200)
    except (urllib.error.URLError, OSError):
        return False

"""The services of the compose file on this machine, without an engine: processes instead of containers."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

from tests.docker.files import read_compose, read_image
from tests.support import REPOSITORY
from tests.support.ports import LOOPBACK, free_port
from tests.support.waiting import wait_until

STOP_S, SECRETS = 20.0, "/run/secrets"
# Programs that the commands call beside Python's own; git, for one, is not in the image.
IN_THE_IMAGE = ("sh", "cat")


class Containers:
    """The services, each with the command and the environment that the files give it.

    Only what an engine would provide is replaced: names of services by 127.0.0.1, their ports by free ones, and
    volumes, secrets and the image's own folders by folders here.

    Args:
        folder: Empty folder for its files.
        postgres_port: Port of PostgreSQL.
        programs: Folder of PostgreSQL's programs.
        password: Password of the database.
        **given: Values of the compose file's variables.
    """

    def __init__(self, folder: Path, postgres_port: int, programs: Path, password: str, **given: str) -> None:
        self.services: dict[str, dict[str, Any]] = read_compose(**given)["services"]
        self.folder, self._image, self._programs = folder, read_image(), programs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self.ports = {name: free_port() for name, each in self.services.items() if "ports" in each}
        self.ports["postgres"] = postgres_port
        self.secret = folder / "secrets" / "database_password"
        for each in ("secrets", "programs", "home"):
            (folder / each).mkdir()
        self.secret.write_text(f"{password}\n")
        for each in IN_THE_IMAGE:
            (folder / "programs" / each).symlink_to(str(shutil.which(each)))
        self._replaced = self._addresses() | self._paths()
        self._pattern = re.compile("|".join(f"(?P<_{place}>{pattern})" for place, pattern in enumerate(self._replaced)))

    def _addresses(self) -> dict[str, str]:
        """Return patterns of the addresses in the files, with their replacements here."""
        replaced = {r"\b0\.0\.0\.0\b": LOOPBACK}
        for name, service in self.services.items():
            for port in service.get("ports", []):
                inside = port.rpartition(":")[2]
                replaced[rf"(?<=[@/]){name}:{inside}\b"] = f"{LOOPBACK}:{self.ports[name]}"
                replaced[rf"\b{inside}\b"] = str(self.ports[name])
        return replaced

    def _paths(self) -> dict[str, str]:
        """Return patterns of the paths in the files, with their replacements here."""
        replaced = {rf"{SECRETS}\b": str(self.secret.parent)}
        replaced |= {re.escape(path): str(here) for path, here in self._image.copied.items()}
        for name in self.services:
            replaced |= {rf"(?<![\w/.]){target}\b": str(here) for here, target, _ in self.volumes(name)}
        return replaced

    def volumes(self, name: str) -> list[tuple[Path, str, list[str]]]:
        """Return the volumes of a service, each with its folder here, its path in the container and its options."""
        split = [volume.split(":") for volume in self.services[name].get("volumes", [])]
        named = [(self.folder / source, target, options) for source, target, *options in split if source[0] != "."]
        for folder, _, _ in named:
            folder.mkdir(exist_ok=True)
        return named

    def here(self, text: str) -> str:
        """Return a text of the files with the addresses and paths of this machine."""
        return self._pattern.sub(lambda found: list(self._replaced.values())[int(str(found.lastgroup)[1:])], text)

    def environment(self, name: str) -> dict[str, str]:
        """Return the whole environment of a service's processes."""
        path = [Path(sys.executable).parent, self.folder / "programs"]
        own = {"HOME": str(self.folder / "home"), "LANG": "C.UTF-8", "PYTHONPATH": str(REPOSITORY)}
        given = self._image.environment | self.services[name].get("environment", {})
        if name == "postgres":
            path = [self._programs]
        own["PATH"] = ":".join(map(str, path))
        return {key: self.here(value) for key, value in given.items() if key != "PATH"} | own

    def is_healthy(self, name: str) -> bool:
        """Return whether a service's health check passes."""
        test = self.services[name].get("healthcheck", {}).get("test", ["CMD", *self._image.healthcheck])
        assert test[0] == "CMD"
        with self._log_of(name).open("ab") as log:
            command = self._command(name, test[1:])
            return subprocess.run(command, **self._surroundings(name, log), check=False).returncode == 0

    def start(self, name: str) -> subprocess.Popen[bytes]:
        """Start a service."""
        command = self._command(name, [*self._image.entrypoint, *shlex.split(self.services[name]["command"])])
        with self._log_of(name).open("ab") as log:
            # In its own session: a Ctrl-C is meant for the parent process.
            self._processes[name] = subprocess.Popen(command, **self._surroundings(name, log), start_new_session=True)
        return self._processes[name]

    def wait_until_healthy(self, name: str) -> None:
        """Wait until the health check of a service passes."""
        wait_until(
            lambda: self.is_healthy(name),
            process=self._processes.get(name),
            log=lambda: self.log(name),
            poll_s=0.5,
        )

    def stop(self, name: str) -> int:
        """Stop a service as an engine does, within the grace period of the file; return its exit code."""
        process = self._processes.pop(name)
        self._terminate(process)
        grace = self.services[name].get("stop_grace_period", "10s")
        try:
            return process.wait(float(grace.removesuffix("s")))
        finally:
            _end(process)

    def stop_all(self) -> None:
        """End the services that are still running."""
        for process in self._processes.values():
            self._terminate(process)
        for process in self._processes.values():
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                pass
            finally:
                _end(process)

    def log(self, name: str) -> str:
        """Return the output of a service."""
        return self._log_of(name).read_text()

    def _log_of(self, name: str) -> Path:
        return self.folder / f"{name}.log"

    def _command(self, name: str, words: Sequence[str]) -> list[str]:
        """Return the command line of a service."""
        return [self.here(word) for word in words]

    def _terminate(self, process: subprocess.Popen[bytes]) -> None:
        process.send_signal(signal.SIGTERM)

    def _surroundings(self, name: str, log: BinaryIO) -> dict[str, Any]:
        folder = self.here(self._image.words["WORKDIR"])
        return {
            "env": self.environment(name),
            "cwd": folder,
            "stdin": subprocess.DEVNULL,
            "stdout": log,
            "stderr": log,
        }


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill what is left of a process's group."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()

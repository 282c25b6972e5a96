"""Processes of this machine: start commands, find what tests have left, and end it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from tests.support.waiting import wait_until

COMMAND = (sys.executable, "-m", "armscan.run")
# Folders that commands were started in.
STARTED: set[Path] = set()


def start_run(
    *words: str, cwd: Path, command: Sequence[str] = COMMAND, environment: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start a command in a session of its own; its output goes to the file `printed`.

    Args:
        *words: Words of its command line.
        cwd: Folder that it is started in.
        command: Words before these. Default: `python -m armscan.run`.
        environment: Environment variables beside those of this process.
    """
    STARTED.add(cwd)
    with (cwd / "printed").open("wb") as printed:
        return subprocess.Popen(
            [*command, *words],
            cwd=cwd,
            env=os.environ | (environment or {}),
            stdout=printed,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def processes_in(folder: Path) -> list[int]:
    """Return the IDs of the processes with this working folder."""
    listing = subprocess.run(["ps", "-eo", "pid="], capture_output=True, text=True, check=True).stdout.split()
    found = []
    for pid in listing:
        try:
            if Path(f"/proc/{pid}/cwd").readlink() == folder:
                found.append(int(pid))
        except OSError:
            continue
    return found


def with_variable(name: str, value: str) -> list[int]:
    """Return the IDs of the processes that were started with a variable in their environment."""
    wanted, found = f"{name}={value}".encode(), []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            try:
                variables = (folder / "environ").read_bytes().split(b"\0")
            # It has ended, or is somebody else's.
            except OSError:
                continue
            if wanted in variables:
                found.append(int(folder.name))
    return found


def kill(pids: Iterable[int], how: signal.Signals = signal.SIGKILL) -> None:
    """Send a signal to the processes that still exist."""
    for pid in pids:
        try:
            os.kill(pid, how)
        except ProcessLookupError:
            continue


def end_all(found: Callable[[], list[int]]) -> None:
    """Kill processes until none is found any more.

    Args:
        found: Function that returns their IDs.
    """

    def are_gone() -> bool:
        pids = found()
        kill(pids)
        return not pids

    wait_until(are_gone, log=lambda: f"processes {found()} do not end", poll_s=0.1)

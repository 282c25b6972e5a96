"""Processes: compute threads, whether a process is still the same, and the end of the parent of this one."""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import psutil

from armscan.utils.files import atomic_write

POLL_S = 0.5
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def limit_threads() -> None:
    """Set one compute thread for this process, if nobody has said otherwise, before a library starts its pool.

    Small networks are fastest so, and jobs side by side never claim more threads than there are cores.
    """
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")


def child_command(module: str, function: str) -> list[str]:
    """Return the command of a child process that runs a function, and may be interrupted while it still imports."""
    program = f"from {module} import {function}\n    {function}()"
    return [sys.executable, "-c", f"try:\n    {program}\nexcept KeyboardInterrupt:\n    raise SystemExit(130)"]


def process_start(pid: int) -> str:
    """Return when a process was started, which tells it from a later one with its ID, however the clock is set.

    Returns:
        An empty text if there is no such process, or if it has ended and has not been waited for.
    """
    try:
        process = psutil.Process(pid)
        # On Linux, the seconds since boot; psutil adds the time of the boot, which moves with the clock.
        since_s = psutil.boot_time() if psutil.LINUX else 0.0
        return "" if process.status() == psutil.STATUS_ZOMBIE else f"{process.create_time() - since_s:.2f}"
    except psutil.Error:
        return ""


@dataclass(frozen=True)
class ProcessInfo:
    """A process, so that others can tell whether it is still alive.

    Args:
        host: the machine that it runs on.
        pid: its ID there.
        started: when it was started, see `process_start`.
        directory: the directory that it works in; empty if nobody has to know.
    """

    host: str
    pid: int
    started: str
    directory: str = ""

    @classmethod
    def current(cls, directory: str = "") -> Self:
        """Return the current process."""
        return cls(socket.gethostname(), os.getpid(), process_start(os.getpid()), directory)

    @classmethod
    def read(cls, file: Path) -> Self:
        """Return the process that a file describes."""
        return cls(**json.loads(file.read_text()))

    def write(self, file: Path) -> None:
        """Write it to a file."""
        atomic_write(file, lambda opened: opened.write(json.dumps(asdict(self)).encode()))

    @property
    def is_here(self) -> bool:
        """Whether it is a process of this machine, of which it is known whether it is alive."""
        return self.host == socket.gethostname()

    @property
    def is_alive(self) -> bool:
        """Whether it has not ended; a process of another machine is taken to be alive."""
        return not self.is_here or process_start(self.pid) == self.started


def on_parent_exit(action: Callable[[], object]) -> None:
    """Call `action` in a thread once the process that started this one has ended."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(POLL_S)
        action()

    threading.Thread(target=watch, daemon=True).start()

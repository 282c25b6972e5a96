"""Processes of this machine: whether one is still the same, and whether the parent of this one is gone."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

POLL_S = 1.0


def process_start(pid: int) -> str:
    """Return when a process was started, in clock ticks since boot, which tells it from a later one with its ID.

    Not by psutil, whose start times move when the clock of the machine is set.

    Returns:
        An empty text if there is no such process, or if it has ended and has not been waited for.
    """
    try:
        # The name before it, in brackets, may hold anything.
        state, *others = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return "" if state == "Z" else others[18]
    except (OSError, ValueError, IndexError):
        return ""


class ParentProcess:
    """The process that started this one."""

    def __init__(self) -> None:
        self._pid = os.getppid()

    @property
    def is_gone(self) -> bool:
        """Whether it has ended."""
        return os.getppid() != self._pid

    def on_exit(self, action: Callable[[], object]) -> None:
        """Call `action` in a thread once the parent has ended."""

        def watch() -> None:
            while not self.is_gone:
                time.sleep(POLL_S)
            action()

        threading.Thread(target=watch, daemon=True).start()

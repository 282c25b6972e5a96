"""Request that a worker leaves, made by signals."""

from __future__ import annotations

import math
import time

# Time that a worker has for its current epoch when it is told to leave soon.
SOON_S = 60.0


class LeaveRequest:
    """Whether a worker is asked to leave: now, or soon.

    Its methods are signal handlers. They take no lock, not even that of `threading.Event`: a handler that interrupts
    another would wait for it forever (see "Execution of Python signal handlers" in the documentation of `signal`).
    """

    def __init__(self) -> None:
        self._is_now = False
        # Deadline of a request to leave soon, by the clock of `time.monotonic`.
        self._late_s = math.inf

    def ask_now(self, *_: object) -> None:
        """Ask to leave now."""
        self._is_now = True

    def ask_soon(self, *_: object) -> None:
        """Ask to leave within `SOON_S` seconds of the first such request."""
        self._late_s = min(self._late_s, time.monotonic() + SOON_S)

    @property
    def is_now(self) -> bool:
        """Whether to leave now."""
        return self._is_now or time.monotonic() >= self._late_s

    @property
    def is_soon(self) -> bool:
        """Whether to leave as soon as that loses nothing."""
        return self._late_s < math.inf

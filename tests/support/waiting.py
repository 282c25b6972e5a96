"""Waits for what a test expects to see, with a limit that only a hang reaches, however busy the machine is."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from typing import Any

HANG_S = 900.0


def wait_until(
    is_seen: Callable[[], object],
    *,
    process: subprocess.Popen[Any] | None = None,
    log: Callable[[], object] = str,
    poll_s: float = 0.05,
) -> None:
    """Wait until a condition is true.

    Args:
        is_seen: Function that returns whether it is true now.
        process: Process that must be alive until then. Default: None.
        log: Function that returns the text to show if it never becomes true.
        poll_s: Pause between two checks, in seconds.
    """
    until_s = time.monotonic() + HANG_S
    while not is_seen():
        assert process is None or process.poll() is None, log()
        assert time.monotonic() < until_s, log()
        time.sleep(poll_s)

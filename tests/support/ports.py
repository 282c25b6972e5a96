"""Free ports of this machine."""

from __future__ import annotations

import socket
from contextlib import ExitStack

LOOPBACK = "127.0.0.1"


def free_ports(n: int, host: str = LOOPBACK) -> list[int]:
    """Return different ports that nothing listens on now."""
    # All at once, so that they differ.
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(n)]
        for each in sockets:
            each.bind((host, 0))
        return [each.getsockname()[1] for each in sockets]


def free_port(host: str = LOOPBACK) -> int:
    """Return a port that nothing listens on now."""
    return free_ports(1, host)[0]

"""Two machines for tests, joined by a cable: each is a network namespace with its own host name."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.support.processes import end_all, kill

NAMESPACES, CLONE_NEWNET = Path("/run/netns"), 0x40000000
CABLE, BITS = "cable", 24


@dataclass(frozen=True)
class Machine:
    """One of the two machines, reachable only from the other.

    Args:
        name: Name of the namespace, which its processes take for the host name.
        address: Address at which the other machine reaches it.
    """

    name: str
    address: str

    def command(self, *words: str) -> list[str]:
        """Return the command line that runs a command there."""
        renamed = 'hostname "$0" && exec "$@"'
        return ["ip", "netns", "exec", self.name, "unshare", "--uts", "sh", "-c", renamed, self.name, *words]

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Enter the network of the machine, with this thread and the processes that it starts."""
        with Path("/proc/thread-self/ns/net").open() as before, (NAMESPACES / self.name).open() as there:
            _enter(there.fileno())
            try:
                yield
            finally:
                _enter(before.fileno())

    def processes(self) -> list[int]:
        """Return the IDs of the processes that run there, except this one."""
        told = subprocess.run(["ip", "netns", "pids", self.name], capture_output=True, text=True, check=True).stdout
        return [int(pid) for pid in told.split() if int(pid) != os.getpid()]

    def crash(self) -> None:
        """Kill everything there at once."""
        kill(self.processes())


def why_not() -> str | None:
    """Return why no machines can be made here; None if they can."""
    for program, package in (("ip", "iproute2"), ("unshare", "util-linux"), ("hostname", "hostname")):
        if shutil.which(program) is None:
            return f"{program} is not installed: apt-get install {package}"
    made = subprocess.run(["unshare", "--net", "--uts", "true"], capture_output=True, text=True, check=False)
    if os.geteuid() != 0 or made.returncode != 0:
        return f"network namespaces cannot be made: they need root ({made.stderr.strip()})"
    return None


@contextmanager
def two_machines() -> Iterator[tuple[Machine, Machine]]:
    """Make two machines; kill what still runs there at the end of the block."""
    machines = tuple(Machine(f"armscan-{os.getpid()}-{number}", f"10.0.0.{number}") for number in (1, 2))
    with ExitStack() as undone:
        for machine in machines:
            _run("ip", "netns", "add", machine.name)
            undone.callback(_run, "ip", "netns", "delete", machine.name)
            undone.callback(end_all, machine.processes)
        first, second = machines
        ends = ["name", CABLE, "netns", first.name, "type", "veth", "peer", "name", CABLE, "netns", second.name]
        _run("ip", "link", "add", *ends)
        for machine in machines:
            _run("ip", "-n", machine.name, "address", "add", f"{machine.address}/{BITS}", "dev", CABLE)
            for device in ("lo", CABLE):
                _run("ip", "-n", machine.name, "link", "set", device, "up")
        yield first, second


def _run(*words: str) -> None:
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, f"{' '.join(words)}: {ended.stderr}"


def _enter(namespace: int) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    if library.setns(namespace, CLONE_NEWNET) != 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))

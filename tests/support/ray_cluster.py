"""A private Ray cluster for tests, of two machines that nobody else reaches."""

from __future__ import annotations

import importlib.util
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.support.machines import Machine, two_machines, why_not

PORT, OBJECT_STORE_BYTES = 6379, 80_000_000
# A dead machine refuses connections and is given up in seconds; a busy one has time to answer.
HEALTH = {
    "RAY_health_check_initial_delay_ms": "1000",
    "RAY_health_check_period_ms": "1000",
    "RAY_health_check_timeout_ms": "60000",
    "RAY_health_check_failure_threshold": "3",
}


def why_not_here() -> str | None:
    """Return why there can be no cluster here; None if there can."""
    if importlib.util.find_spec("ray") is None:
        return "Ray is not installed: pip install 'armscan[ray]'"
    return why_not()


@dataclass(frozen=True)
class RayCluster:
    """Two machines with two cores each, as far as Ray knows.

    Args:
        head: Machine that the command is typed on.
        other: Second machine.
        environment: Environment variables of a command that uses the cluster.
    """

    head: Machine
    other: Machine
    environment: Mapping[str, str]


@contextmanager
def ray_cluster(environment: Mapping[str, str]) -> Iterator[RayCluster]:
    """Start a cluster; stop it at the end of the block.

    Args:
        environment: Environment variables of both machines, beside those of this process.
    """
    # Short, because the length of socket paths is limited.
    folder = Path(tempfile.mkdtemp(prefix="armscan-ray-"))
    try:
        with two_machines() as (head, other):
            token = folder / "token"
            token.touch(mode=0o600)
            token.write_text(secrets.token_hex(32))
            # Set explicitly: otherwise earlier uses on this machine decide.
            access = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token), "RAY_USAGE_STATS_ENABLED": "0"}
            address = f"{head.address}:{PORT}"
            of_nodes = access | HEALTH | environment
            _start(head, folder, of_nodes, "--head", f"--port={PORT}", "--include-dashboard=false")
            _start(other, folder, of_nodes, f"--address={address}")
            yield RayCluster(head, other, access | {"RAY_ADDRESS": address})
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _start(machine: Machine, folder: Path, environment: Mapping[str, str], *words: str) -> None:
    own = folder / machine.address
    own.mkdir()
    program = str(Path(sys.executable).with_name("ray"))
    words = (f"--node-ip-address={machine.address}", f"--temp-dir={own}", "--num-cpus=2", *words)
    with (folder / f"{machine.address}.log").open("ab") as log:
        ended = subprocess.run(
            machine.command(program, "start", f"--object-store-memory={OBJECT_STORE_BYTES}", *words),
            # Not the folder of the command that uses it.
            cwd=own,
            env=os.environ | environment,
            stdout=log,
            stderr=log,
            check=False,
        )
    assert ended.returncode == 0, (folder / f"{machine.address}.log").read_text()

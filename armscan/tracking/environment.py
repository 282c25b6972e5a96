"""What a run was computed with: Python, the machine, and the version of every package."""

from __future__ import annotations

import functools
import json
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name

from armscan.tracking.git import UNKNOWN
from armscan.utils.files import sha256

# Those that a run's figures may depend on; of the others, the file has the versions.
TOLD = ("torch", "tianshou", "gymnasium", "numpy", "numba", "scipy", "simpleitk", "optuna", "mlflow", "hydra-core")
PYTHON, CONSTRAINTS_SUM = "version.python", "constraints.sha256"


@functools.cache
def environment() -> Mapping[str, Any]:
    """Return Python, the machine and the packages of this process, once, as plain values."""
    found = [(each.metadata["Name"], each.version) for each in metadata.distributions()]
    packages = {canonicalize_name(name): version for name, version in found if name}
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "packages": dict(sorted(packages.items())),
    }


def environment_file() -> bytes:
    """Return the contents of the file that a run keeps of its environment."""
    return json.dumps(environment(), indent=1).encode()


def environment_tags() -> dict[str, str]:
    """Return the versions that figures may depend on, and the sum of the constraints that were to be installed."""
    packages = environment()["packages"]
    constraints = Path(__file__).parents[2] / "constraints.txt"
    return {
        PYTHON: environment()["python"],
        **{f"version.{name}": packages.get(name, "not installed") for name in TOLD},
        # Beside the code of a clone; a wheel has none.
        CONSTRAINTS_SUM: sha256(constraints.read_bytes()) if constraints.is_file() else UNKNOWN,
    }

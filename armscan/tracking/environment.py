"""Environment of a run: Python, the machine, and the version of every package."""

from __future__ import annotations

import functools
import json
import platform
import re
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name

from armscan.tracking.tags import UNKNOWN
from armscan.utils.files import PACKAGE_FOLDERS, sha256

# Packages that a run's results may depend on; the environment file has the versions of all.
REPORTED_PACKAGES = (
    "torch",
    "tianshou",
    "gymnasium",
    "numpy",
    "numba",
    "scipy",
    "simpleitk",
    "optuna",
    "mlflow",
    "hydra-core",
)
PYTHON, CONSTRAINTS_SUM = "version.python", "constraints.sha256"
HEADER = re.compile(r"^(Name|Version): *(\S+)", re.MULTILINE)


@functools.cache
def environment() -> Mapping[str, Any]:
    """Return the Python version, the machine and the packages of this process as plain values, read once."""
    # Skip packages vendored inside another one: Ray adds such a folder to the path when it is imported.
    folders = [folder for folder in sys.path if not PACKAGE_FOLDERS & {*Path(folder).parent.parts}]
    found = [*map(_name_and_version, metadata.distributions(path=folders))]
    # Of several versions on the path, Python imports the first.
    packages = {canonicalize_name(name): version for name, version in reversed(found) if name}
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "packages": dict(sorted(packages.items())),
    }


def _name_and_version(package: metadata.Distribution) -> tuple[str, str]:
    """Return a package's name and version; for all packages, the standard e-mail parser would take a second."""
    text = package.read_text("METADATA") or package.read_text("PKG-INFO") or ""
    fields = dict(HEADER.findall(text.partition("\n\n")[0]))
    return fields.get("Name", ""), fields.get("Version", UNKNOWN)


def environment_file() -> bytes:
    """Return the contents of a run's environment file."""
    return json.dumps(environment(), indent=1).encode()


def environment_tags() -> dict[str, str]:
    """Return, as tags, the versions that results may depend on and the checksum of `constraints.txt`."""
    packages = environment()["packages"]
    constraints = Path(__file__).parents[2] / "constraints.txt"
    return {
        PYTHON: environment()["python"],
        **{f"version.{name}": packages.get(name, "not installed") for name in REPORTED_PACKAGES},
        # Only a clone has this file, a wheel does not.
        CONSTRAINTS_SUM: sha256(constraints.read_bytes()) if constraints.is_file() else UNKNOWN,
    }

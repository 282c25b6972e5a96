"""The folders of the repository, and the environment of processes that run its code."""

from __future__ import annotations

import os
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PICTURES = REPOSITORY / "docs" / "images"
VOLUMES = REPOSITORY / "tests" / "data" / "volumes"


def environment(python_path: Path | str = REPOSITORY, **variables: str) -> dict[str, str]:
    """Return the environment of a process that runs on one thread.

    Args:
        python_path: Where Python finds the code. Default: this repository.
        **variables: Further variables.
    """
    return os.environ | {"PYTHONPATH": str(python_path), "OMP_NUM_THREADS": "1", **variables}

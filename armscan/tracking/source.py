"""Which state of the code a run was made with."""

from __future__ import annotations

import functools
import re
import subprocess
from collections.abc import Mapping
from pathlib import Path


@functools.cache
def source_tags() -> Mapping[str, str]:
    """Returns the git commit of the code and whether its tree was dirty; 'unknown' where the code is under no git.

    Once for a process, whose code stays what it was when it was loaded.
    """
    folder = Path(__file__).parent
    commit = _git("rev-parse", "HEAD", folder=folder)
    if commit is None:
        return {"git.commit": "unknown", "git.dirty": "unknown"}
    changes = _git("status", "--porcelain", folder=folder)
    return {"git.commit": commit, "mlflow.source.git.commit": commit, "git.dirty": str(changes != "").lower()}


def _git(*arguments: str, folder: Path) -> str | None:
    try:
        answer = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def release(version: str) -> tuple[int, ...]:
    """Returns a version of armscan as numbers, to be compared."""
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])

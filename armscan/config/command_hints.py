"""Commands that messages suggest, ready to paste: with `uv run` or a path unless the environment is activated."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from armscan.config.defaults import RESUME, TRACKING_URI, default_storage, default_tracking
from armscan.config.trust import TRUST
from armscan.utils.files import SQLITE_PREFIX

RUN = ("python", "-m", "armscan.run")
# The user's working folder; a resumed run changes to another one.
STARTED_IN = Path.cwd()
# `uv run` sets it for the programs that it starts.
UV_RUN = "UV_RUN_RECURSION_DEPTH"


@cache
def typed(program: str) -> tuple[str, ...]:
    """Return the arguments that start a program of this Python's environment, from the folder of the command."""
    if UV_RUN in os.environ:
        return "uv", "run", program
    file, found = Path(sys.executable).with_name(program), shutil.which(program)
    if not file.exists() or (found is not None and Path(found).parent.samefile(file.parent)):
        return (program,)
    return (str(file.relative_to(STARTED_IN) if file.is_relative_to(STARTED_IN) else file),)


def kept_command(overrides: Iterable[str]) -> str:
    """Return the command that runs these Hydra overrides, in the machine-independent form that a run stores."""
    return shlex.join([*RUN, *overrides])


def run_command(overrides: Iterable[str]) -> str:
    """Return the command that runs these Hydra overrides."""
    return shlex.join([*typed(RUN[0]), *RUN[1:], *overrides])


def resume_command(run_id: str, tracking_uri: str, *, trust: bool) -> str:
    """Return the command that resumes a run.

    Args:
        run_id: MLflow run ID.
        tracking_uri: MLflow tracking URI of its store.
        trust: Whether the command needs `--trust`.
    """
    where = () if _is_default_store(tracking_uri) else (f"{TRACKING_URI}={tracking_uri}",)
    return run_command([f"{RESUME}={run_id}", *where, *((TRUST,) if trust else ())])


def armscan_command(
    *arguments: str, tracking: str | None = None, storage: str | None = None, trust: bool = False
) -> str:
    """Return a command of the program `armscan`.

    Args:
        arguments: Name of the command, and its arguments.
        tracking: MLflow tracking URI, added unless it is the default one. Default: None, no URI.
        storage: Optuna storage, added unless it is the default one. Default: None, no storage.
        trust: Whether the command needs `--trust`. Default: False.
    """
    stores = ["--storage", storage] if storage is not None and storage != default_storage() else []
    stores += ["--tracking", tracking] if tracking is not None and not _is_default_store(tracking) else []
    return shlex.join([*typed("armscan"), *arguments, *stores, *((TRUST,) if trust else ())])


def _is_default_store(uri: str) -> bool:
    """Return whether a command that is typed here uses this tracking store by default."""
    default = str(default_tracking()["uri"])
    file = default.removeprefix(SQLITE_PREFIX)
    return uri == default or (file != default and uri == f"{SQLITE_PREFIX}{STARTED_IN / file}")

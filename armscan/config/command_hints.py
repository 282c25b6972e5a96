"""The commands that messages suggest."""

from __future__ import annotations

import shlex
from collections.abc import Iterable

from armscan.config.defaults import RESUME, TRACKING_URI, default_storage, default_tracking
from armscan.config.trust import TRUST

RUN = ("python", "-m", "armscan.run")


def run_command(words: Iterable[str]) -> str:
    """Return the command that runs what these Hydra overrides describe."""
    return shlex.join([*RUN, *words])


def resume_command(run_id: str, tracking_uri: str, *, trust: bool = False) -> str:
    """Return the command that resumes a run.

    Args:
        run_id: MLflow run ID.
        tracking_uri: MLflow tracking URI of its store.
        trust: whether it needs `--trust`. Default: False.
    """
    where = () if tracking_uri == default_tracking()["uri"] else (f"{TRACKING_URI}={tracking_uri}",)
    return run_command([f"{RESUME}={run_id}", *where, *((TRUST,) if trust else ())])


def armscan_command(*words: str, tracking: str | None = None, storage: str | None = None) -> str:
    """Return a command of the program `armscan`, with the stores that are not the default ones."""
    stores = ["--storage", storage] if storage is not None and storage != default_storage() else []
    stores += ["--tracking", tracking] if tracking is not None and tracking != default_tracking()["uri"] else []
    return shlex.join(["armscan", *words, *stores])

"""Tracking stores in the folder of a test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from armscan.tracking import open_store


def store_in(folder: Path, experiment: str, *, artifacts: str = "artifacts", **options: Any) -> tuple[Any, str]:
    """Open `mlruns.db` in a folder, with the artifacts beside it; return the store and the ID of the experiment.

    Args:
        folder: Folder of the test.
        experiment: Name of the experiment.
        artifacts: Name of the folder of the artifacts.
        **options: Further arguments of `open_store`.
    """
    uri, path = f"sqlite:///{folder}/mlruns.db", str(folder / artifacts)
    return open_store(uri, experiment=experiment, artifacts=path, wait_s=60.0, **options)

"""The commands that messages suggest."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path

from armscan.config.defaults import RESUME, TRACKING_URI, default_storage, default_tracking

RUN = ("python", "-m", "armscan.run")


def run_command(words: Iterable[str]) -> str:
    """Return the command that runs what these Hydra overrides describe."""
    return shlex.join([*RUN, *words])


def resume_command(run_id: str, tracking_uri: str) -> str:
    """Return the command that resumes a run."""
    where = () if tracking_uri == default_tracking()["uri"] else (f"{TRACKING_URI}={tracking_uri}",)
    return run_command([f"{RESUME}={run_id}", *where])


def evaluate_command(run_id: str, tracking_uri: str) -> str:
    """Return the command that evaluates the agent of a run."""
    return _command("evaluate", run_id, tracking=tracking_uri)


def video_command(run_id: str, tracking_uri: str) -> str:
    """Return the command that records the agent of a run."""
    return _command("evaluate", run_id, "--video", tracking=tracking_uri)


def reproduce_command(run_id: str, tracking_uri: str) -> str:
    """Return the command that reproduces a run."""
    return _command("runs", "reproduce", run_id, tracking=tracking_uri)


def sync_command(folder: Path | str) -> str:
    """Return the command that delivers what the runs in a folder could not upload."""
    return _command("runs", "sync", str(folder))


def report_command(study: str, storage: str) -> str:
    """Return the command that reports on a study."""
    return _command("report", "--study", study, storage=storage)


def compare_command(run_id: str, tracking_uri: str) -> str:
    """Return the command that compares the trainings below a run."""
    return _command("report", "--runs", run_id, tracking=tracking_uri)


def label_command(data: Path, markup: str) -> str:
    """Return the command that reads a plane from a markups file."""
    return _command("data", "label", str(data), "--volume", "NAME", "--markup", markup)


def ui_command(*, tracking: str | None = None, storage: str | None = None) -> str:
    """Return the command that opens runs and studies in the browser; None stands for the default store."""
    return _command("ui", tracking=tracking, storage=storage)


def _command(*words: str, tracking: str | None = None, storage: str | None = None) -> str:
    """Return a command, with stores that are not the default ones."""
    stores = ["--storage", storage] if storage is not None and storage != default_storage() else []
    stores += ["--tracking", tracking] if tracking is not None and tracking != default_tracking()["uri"] else []
    return shlex.join(["armscan", *words, *stores])

"""`python -m armscan.run resume=RUN_ID`: a run that was cut off goes on, and ends as if nothing had happened.

Whatever could make it end otherwise is refused before anything of the run is touched: another configuration, other
volumes, another run's checkpoints, a damaged checkpoint.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from mlflow.entities import Run
from omegaconf import DictConfig, OmegaConf

import armscan
from armscan.agents import Learner
from armscan.errors import InvalidValueError, ResumeError
from armscan.experiment import carry_out, place_tags, volume_tags
from armscan.files import (
    CONFIG_FILE,
    LAST_CHECKPOINT,
    SUM_TAGS,
    VOLUMES_FILE,
    held,
    remove_unfinished,
    sum_of,
)
from armscan.settings import RESUME, TRACKING_URI, plain, usual_tracking
from armscan.stage import Stage
from armscan.tracking import TrackedRun, TrackingStore, find_run, jobs_of, open_existing_store, sync
from armscan.tracking.source import release
from armscan.training import Fingerprints, check_unchanged, take_up


def resume(words: Sequence[str]) -> dict[str, dict[str, float]]:
    """Goes on with the run that a command line names.

    Args:
        words: of the command line.

    Returns:
        The figures of the final evaluations, by the name of their volumes.

    Raises:
        InvalidValueError: if the words say anything else.
        TrackingError: if the run is not found.
        ResumeError: if it cannot go on.
        FolderInUseError: if it is still going on.
        CheckpointError: if its checkpoint is damaged or another run's.
        ChangedVolumesError: if its volumes are not those any more that it was started with.
    """
    wanted, uri = _read(words)
    client = open_existing_store(uri)
    return go_on(client, find_run(client, wanted).info.run_id)


def go_on(client: TrackingStore, run_id: str, *, job_label: str | None = None) -> dict[str, dict[str, float]]:
    """Goes on with a run; see `resume`.

    Args:
        client: of the store that it is in.
        run_id: of the run.
        job_label: what stands before the lines of one job of several, None for a single run.
    """
    folder = _folder_of(client, client.get_run(run_id))
    with held(folder):
        # What it has left because the store was away; it may have ended just before the folder was free.
        sync(folder, lambda _: client)
        run = client.get_run(run_id)
        if run.info.status == "FINISHED":
            raise ResumeError(f"run {run_id} has finished: there is nothing to resume")
        config = _config_of(run, folder)
        _check_last_checkpoint(run, folder)
        remove_unfinished(folder)
        _enter_working_folder(run)
        print(f"preparing to go on with {run.info.run_name}, run {run_id}", flush=True)
        stage = Stage.built(config)
        _check_volumes(run, folder, stage.fingerprints)
        agent, split = stage.experiment.agent, stage.experiment.split
        earlier = take_up(agent, folder, stage.origin(run_id)) if isinstance(agent, Learner) else []
        tags = volume_tags(split) | place_tags(folder)
        tracked = TrackedRun.go_on(client, run_id, folder=folder, config=plain(config), tags=tags)
        return carry_out(stage, tracked, folder, client.uri, job_label=job_label, earlier=earlier)


def _read(words: Sequence[str]) -> tuple[str, str]:
    """Returns the wanted run and the store to look in."""
    values = {TRACKING_URI: usual_tracking()["uri"]}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals or key not in (RESUME, TRACKING_URI):
            raise InvalidValueError(
                f"{word!r} stands beside {RESUME}=, but a run goes on with the configuration it was started with: "
                f"only {TRACKING_URI}= may be added"
            )
        if key in values and key == RESUME and values[key] != text:
            raise InvalidValueError(f"{RESUME} names {values[key]!r} and {text!r}, but one run is resumed at a time")
        values[key] = text
    return values[RESUME], values[TRACKING_URI]


def _folder_of(client: TrackingStore, run: Run) -> Path:
    """Returns the folder of a run that this version can go on with."""
    run_id, tags = run.info.run_id, run.data.tags
    if "folder" not in tags:
        if jobs := jobs_of(client, run):
            cut_off = [job.info.run_id for job in jobs if job.info.status != "FINISHED"]
            which = ", ".join(cut_off) if cut_off else "all of them have finished"
            raise ResumeError(f"run {run_id} is the parent of a multirun, whose jobs are resumed one by one: {which}")
        raise ResumeError(f"run {run_id} cannot be resumed: it is none of armscan.run, which notes the folder of a run")
    if release(tags["armscan.version"]) > release(armscan.__version__):
        raise ResumeError(
            f"run {run_id} was made by armscan {tags['armscan.version']}, but this is {armscan.__version__}: "
            "it goes on with that version or a newer one"
        )
    # Asked before the folder, which may have been cleared away since.
    if run.info.status == "FINISHED":
        raise ResumeError(f"run {run_id} has finished: there is nothing to resume")
    folder = Path(tags["folder"])
    if not folder.is_dir():
        raise ResumeError(
            f"run {run_id} cannot be resumed: its folder {folder} is not there; it last ran on the host {tags['host']}"
        )
    return folder


def _config_of(run: Run, folder: Path) -> DictConfig:
    """Returns the configuration that a run was started with."""
    config: dict[str, Any] = yaml.safe_load(_started_with(run, folder / CONFIG_FILE, "configuration"))
    return OmegaConf.create(config)


def _started_with(run: Run, file: Path, what: str) -> bytes:
    """Returns the contents of a file that a run was started with."""
    try:
        contents = file.read_bytes()
    except OSError as error:
        raise ResumeError(f"{file}: the run's {what} cannot be read ({error.strerror})") from error
    if sum_of(contents) != run.data.tags[SUM_TAGS[file.name]]:
        raise ResumeError(
            f"{file}: is not the {what} that run {run.info.run_id} was started with: changed, or another run's"
        )
    return contents


def _check_last_checkpoint(run: Run, folder: Path) -> None:
    """Raises `ResumeError` where a training would begin again whose epochs are tracked already."""
    last = folder / LAST_CHECKPOINT
    if not last.exists() and any(name.startswith("validation/") for name in run.data.metrics):
        raise ResumeError(
            f"{last}: there is no such checkpoint any more, but run {run.info.run_id} has tracked epochs, which would "
            "be trained and tracked again: put it back, or start another run"
        )


def _check_volumes(run: Run, folder: Path, now: Fingerprints) -> None:
    """Raises `ChangedVolumesError` where a run would go on with other volumes, whether it has a checkpoint or not."""
    # Of runs that were started before it was kept, the checkpoint says so.
    if SUM_TAGS[VOLUMES_FILE] in run.data.tags:
        then = json.loads(_started_with(run, folder / VOLUMES_FILE, "record of its volumes"))
        check_unchanged(then, now, f"run {run.info.run_id} was started with")


def _enter_working_folder(run: Run) -> None:
    """Goes to where the run was started, from where its configuration names files."""
    folder = run.data.tags["working_folder"]
    try:
        os.chdir(folder)
    except OSError as error:
        raise ResumeError(
            f"run {run.info.run_id} was started in {folder}, from where its configuration names files, but one cannot "
            f"go there ({error.strerror})"
        ) from error

"""Resume an interrupted run, with the results of an uninterrupted one.

A changed configuration, changed volumes, and checkpoints that are damaged or another run's are refused before training
continues.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from omegaconf import OmegaConf

from armscan.agents import Learner
from armscan.config.own_code import changed_modules
from armscan.config.trust import stored_config
from armscan.errors import ResumeError, few, printable
from armscan.experiment.build import RunSetup, set_up
from armscan.experiment.provenance import place_tags, volume_tags
from armscan.experiment.runner import run_tracked
from armscan.tracking import TrackedRun, TrackingStore, check_version, sync
from armscan.tracking.tags import FOLDER_TAG, HOST_TAG, OWN_CODE_TAG, STUDY_TAG, VALIDATION_PREFIX, WORKING_FOLDER_TAG
from armscan.training import Fingerprints, check_unchanged, fingerprints_in, resume_from_checkpoint
from armscan.utils.files import NAMED_PIPE, remove_unfinished, sha256
from armscan.utils.run_files import (
    CONFIG_FILE,
    LAST_CHECKPOINT,
    OUTBOX_FOLDER,
    OUTBOX_SUFFIXES,
    SHA256_TAGS,
    VOLUMES_FILE,
    folder_lock,
)
from armscan.utils.strict_yaml import load_yaml

if TYPE_CHECKING:
    from mlflow.entities import Run


def tag_of(run: Run, name: str) -> str:
    """Return a tag that every run of `armscan run` has."""
    try:
        return str(run.data.tags[name])
    except KeyError as error:
        raise ResumeError(f"run {run.info.run_id} has no tag {name}, which every run of armscan run has") from error


def resume_run(
    store: TrackingStore, run_id: str, *, job_label: str | None = None, trust: bool = False
) -> dict[str, dict[str, float]]:
    """Resume a run; see `resume`. The printed lines of a grid's job begin with its label."""
    run = store.get_run(run_id)
    store.check_artifacts_of(run)
    folder = _folder_of(run)
    with folder_lock(folder):
        # Send what it could not send before; it may also have finished just before the lock was free.
        sync(folder, lambda _: store)
        run = store.get_run(run_id)
        check_unfinished(run)
        config = _config_of(run, folder)
        migrated = stored_config(config, where=f"run {run_id}", trust=trust)
        _check_last_checkpoint(run, folder)
        remove_unfinished(folder)
        enter_working_folder(run, trust=trust)
        print(f"resuming {printable(run.info.run_name)}, run {run_id}", flush=True)
        setup = set_up(OmegaConf.create(migrated))
        _check_volumes(run, folder, setup.fingerprints)
        check_own_code(run, setup)
        agent = setup.agent
        earlier = resume_from_checkpoint(agent, folder, setup.provenance(run_id)) if isinstance(agent, Learner) else []
        tags = volume_tags(setup) | place_tags(folder)
        tracked = TrackedRun.reopen(store, run, folder=folder, config=config, tags=tags)
        return run_tracked(setup, tracked, folder, store.uri, job_label=job_label, earlier=earlier)


def _folder_of(run: Run) -> Path:
    """Return the folder of a run that this version can continue with."""
    run_id, tags = run.info.run_id, run.data.tags
    if STUDY_TAG in tags and FOLDER_TAG not in tags:
        raise ResumeError(f"run {run_id} belongs to the study {printable(tags[STUDY_TAG])}: type its command again")
    if FOLDER_TAG not in tags:
        raise ResumeError(
            f"run {run_id} cannot be resumed: it was not started by armscan run, which tags a run with its folder"
        )
    check_version(run)
    # Checked before the folder, which may have been deleted since.
    check_unfinished(run)
    folder = Path(tags[FOLDER_TAG])
    if not folder.is_dir():
        raise ResumeError(
            f"run {run_id} cannot be resumed: its folder {folder} is not there; it last ran on the host "
            f"{tag_of(run, HOST_TAG)}"
        )
    outboxes = {file.stem for file in (folder / OUTBOX_FOLDER).glob(f"*{OUTBOX_SUFFIXES[-1]}")}
    if outboxes and run_id not in outboxes:
        raise ResumeError(f"run {run_id} cannot be resumed: {folder} is the folder of run {min(outboxes)}")
    return folder


def check_unfinished(run: Run) -> None:
    """Raise `ResumeError` if a run has finished."""
    if run.info.status == "FINISHED":
        raise ResumeError(f"run {run.info.run_id} has finished: there is nothing to resume")


def _config_of(run: Run, folder: Path) -> dict[str, Any]:
    """Return the configuration that a run was started with, as its version wrote it."""
    try:
        return dict(load_yaml(_started_with(run, folder / CONFIG_FILE, "configuration")))
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ResumeError(f"{folder / CONFIG_FILE}: the run's configuration is damaged") from error


def _started_with(run: Run, file: Path, what: str) -> bytes:
    """Return the contents of a file that a run was started with."""
    if file.is_fifo():
        raise ResumeError(f"{file}: {NAMED_PIPE}")
    try:
        contents = file.read_bytes()
    except OSError as error:
        raise ResumeError(f"{file}: the run's {what} cannot be read ({error.strerror})") from error
    if sha256(contents) != tag_of(run, SHA256_TAGS[file.name]):
        raise ResumeError(
            f"{file}: is not the {what} that run {run.info.run_id} was started with: changed, or another run's"
        )
    return contents


def _check_last_checkpoint(run: Run, folder: Path) -> None:
    """Raise `ResumeError` if a training would restart although its epochs have been tracked."""
    last = folder / LAST_CHECKPOINT
    if not last.exists() and any(name.startswith(VALIDATION_PREFIX) for name in run.data.metrics):
        raise ResumeError(
            f"{last}: this checkpoint is gone, but run {run.info.run_id} has tracked epochs, which would "
            "be trained and tracked again: put it back, or start another run"
        )


def _check_volumes(run: Run, folder: Path, now: Fingerprints) -> None:
    """Raise `ChangedVolumesError` if a run would continue with other volumes, whether it has a checkpoint or not."""
    # Older runs have no such record; their checkpoint holds the fingerprints.
    if SHA256_TAGS[VOLUMES_FILE] in run.data.tags:
        record = folder / VOLUMES_FILE
        then = fingerprints_in(_started_with(run, record, "record of its volumes"), str(record))
        check_unchanged(then, now, f"run {run.info.run_id} was started with")


def check_own_code(run: Run, setup: RunSetup) -> None:
    """Raise `ResumeError` if a run would continue with other code of the user's own classes."""
    if changed := changed_modules(run.data.tags.get(OWN_CODE_TAG), setup.own_code):
        raise ResumeError(
            f"run {run.info.run_id} was started with other code of {few(changed)}: put it back, or start another run"
        )


def enter_working_folder(run: Run, *, trust: bool) -> None:
    """Change to the working folder of the run, where its relative paths begin and, if trusted, its own classes are."""
    folder, left = tag_of(run, WORKING_FOLDER_TAG), str(Path.cwd())
    try:
        os.chdir(folder)
    # ValueError: the path has characters that no path can have.
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ResumeError(
            f"run {run.info.run_id} was started in {folder}, where its relative paths begin, but that folder cannot be "
            f"entered ({reason})"
        ) from error
    if trust:
        sys.path[:] = [folder if each == left else each for each in sys.path]

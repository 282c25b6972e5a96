"""`armscan run resume=ID`: resume an interrupted run, with the results of an uninterrupted one, or complete a grid.

A changed configuration, changed volumes, and checkpoints that are damaged or another run's are refused before training
continues.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from pydantic import TypeAdapter, ValidationError

from armscan.agents import Learner
from armscan.config.defaults import RESUME, TRACKING_URI, default_tracking
from armscan.config.own_code import changed_modules
from armscan.config.trust import TRUST, check_stored_overrides, stored_config
from armscan.errors import InvalidValueError, ResumeError, UntrustedError, few, printable
from armscan.experiment.build import RunSetup, set_up
from armscan.experiment.provenance import place_tags, volume_tags
from armscan.experiment.runner import run_tracked
from armscan.tracking import TrackedRun, TrackingStore, check_run_id, check_version, find_run, open_existing_store, sync
from armscan.tracking.notes import Note
from armscan.tracking.tags import FOLDER_TAG, GRID_TAG, HOST_TAG, OWN_CODE_TAG, STUDY_TAG, WORKING_FOLDER_TAG
from armscan.training import Fingerprints, check_unchanged, fingerprints_in, resume_from_checkpoint
from armscan.utils.files import SQLITE_PREFIX, remove_unfinished, sha256, sqlite_file
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


def resume(arguments: Sequence[str], repeat_grid: Callable[..., None]) -> None:
    """Resume the run that a command line names.

    Args:
        arguments: Arguments of the command line.
        repeat_grid: Function that runs the unfinished jobs of a grid; see `armscan.run.repeat_grid`.

    Raises:
        InvalidValueError: If they say anything else.
        UntrustedError: If it would execute code of others, and there is no `--trust`.
        ArmscanError: If there is no such run, it is still running, or its checkpoint or volumes are not its own.
    """
    trust = TRUST in arguments
    wanted, uri = _read([each for each in arguments if each != TRUST])
    check_run_id(wanted)
    store = open_existing_store(uri)
    run = find_run(store, wanted)
    if GRID_TAG not in run.data.tags:
        resume_run(store, run.info.run_id, trust=trust)
        return
    _check_unfinished(run)
    _check_ended(run)
    grid = _grid_of(run)
    if not trust:
        _check_grid(run, grid, uri)
    _enter_working_folder(run, trust=trust)
    _check_store(run, grid, store.uri)
    repeat_grid(grid, run.info.run_id, trust=trust)


def _check_store(run: Run, overrides: Sequence[str], uri: str) -> None:
    """Raise `ResumeError` if the jobs of a grid would be tracked in another store than the one that it was read from.

    To be called in the grid's working folder, where a relative address of its store begins.
    """
    parsed = OverridesParser.create().parse_overrides([*overrides])
    given = [each for each in parsed if each.key_or_group == TRACKING_URI]
    stored = str(given[-1].value()) if given else uri
    places = [
        str(Path(sqlite_file(each)).resolve()) if each.startswith(SQLITE_PREFIX) else each.rstrip("/")
        for each in (stored, uri)
    ]
    if places[0] != places[1]:
        raise ResumeError(
            f"run {run.info.run_id} was tracked in {stored}, where its jobs would be tracked again, and not in {uri}: "
            "put the store back under its old address, or start the grid again"
        )


def _grid_of(run: Run) -> list[str]:
    """Return the overrides that repeat a grid."""
    try:
        return TypeAdapter(list[str]).validate_json(_tag(run, GRID_TAG), strict=True)
    except ValidationError as error:
        raise ResumeError(f"run {run.info.run_id}: its tag {GRID_TAG} holds no overrides") from error


def _tag(run: Run, name: str) -> str:
    """Return a tag that every run of `armscan run` has."""
    try:
        return str(run.data.tags[name])
    except KeyError as error:
        raise ResumeError(f"run {run.info.run_id} has no tag {name}, which every run of armscan run has") from error


def _check_grid(run: Run, overrides: Sequence[str], uri: str) -> None:
    """Raise `UntrustedError` if a grid's command line, or its working folder, is untrusted."""
    where = f"run {run.info.run_id}"
    check_stored_overrides(overrides, uri, where=where)
    # Its `conf/` and `sweeps/` are part of the configuration.
    folder = Path(_tag(run, WORKING_FOLDER_TAG))
    if folder.resolve() != Path.cwd().resolve():
        raise UntrustedError(
            f"{where}: it was started in {folder}, whose configuration could execute code of others; repeat the "
            f"command there or, if you trust its author, with {TRUST}"
        )


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
        _check_unfinished(run)
        config = _config_of(run, folder)
        migrated = stored_config(config, where=f"run {run_id}", trust=trust)
        _check_last_checkpoint(run, folder)
        remove_unfinished(folder)
        _enter_working_folder(run, trust=trust)
        print(f"resuming {printable(run.info.run_name)}, run {run_id}", flush=True)
        setup = set_up(OmegaConf.create(migrated))
        _check_volumes(run, folder, setup.fingerprints)
        check_own_code(run, setup)
        agent = setup.agent
        earlier = resume_from_checkpoint(agent, folder, setup.provenance(run_id)) if isinstance(agent, Learner) else []
        tags = volume_tags(setup) | place_tags(folder)
        tracked = TrackedRun.reopen(store, run, folder=folder, config=config, tags=tags)
        return run_tracked(setup, tracked, folder, store.uri, job_label=job_label, earlier=earlier)


def _read(overrides: Sequence[str]) -> tuple[str, str]:
    """Return the wanted run and the store to look in."""
    values = {TRACKING_URI: default_tracking()["uri"]}
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or key not in (RESUME, TRACKING_URI):
            raise InvalidValueError(
                f"{override!r} cannot be combined with {RESUME}=, because a run keeps its original configuration: "
                f"only {TRACKING_URI}= and {TRUST} may be added"
            )
        if key in values and key == RESUME and values[key] != text:
            raise InvalidValueError(f"{RESUME} names {values[key]!r} and {text!r}, but one run is resumed at a time")
        values[key] = text
    return values[RESUME], values[TRACKING_URI]


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
    _check_unfinished(run)
    folder = Path(tags[FOLDER_TAG])
    if not folder.is_dir():
        raise ResumeError(
            f"run {run_id} cannot be resumed: its folder {folder} is not there; it last ran on the host "
            f"{_tag(run, HOST_TAG)}"
        )
    outboxes = {file.stem for file in (folder / OUTBOX_FOLDER).glob(f"*{OUTBOX_SUFFIXES[-1]}")}
    if outboxes and run_id not in outboxes:
        raise ResumeError(f"run {run_id} cannot be resumed: {folder} is the folder of run {min(outboxes)}")
    return folder


def _check_unfinished(run: Run) -> None:
    if run.info.status == "FINISHED":
        raise ResumeError(f"run {run.info.run_id} has finished: there is nothing to resume")


def _check_ended(run: Run) -> None:
    """Raise `ResumeError` if a grid's launcher is alive on this machine: its jobs would be taken from it."""
    launcher = note.process if (note := Note.of(run.info.run_id)) is not None else None
    if run.info.status == "RUNNING" and launcher is not None and launcher.is_here and launcher.is_alive:
        raise ResumeError(
            f"run {run.info.run_id} is still running, in process {launcher.pid}: wait until it ends, or interrupt it"
        )


def _config_of(run: Run, folder: Path) -> dict[str, Any]:
    """Return the configuration that a run was started with, as its version wrote it."""
    try:
        return dict(load_yaml(_started_with(run, folder / CONFIG_FILE, "configuration")))
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ResumeError(f"{folder / CONFIG_FILE}: the run's configuration is damaged") from error


def _started_with(run: Run, file: Path, what: str) -> bytes:
    """Return the contents of a file that a run was started with."""
    try:
        contents = file.read_bytes()
    except OSError as error:
        raise ResumeError(f"{file}: the run's {what} cannot be read ({error.strerror})") from error
    if sha256(contents) != _tag(run, SHA256_TAGS[file.name]):
        raise ResumeError(
            f"{file}: is not the {what} that run {run.info.run_id} was started with: changed, or another run's"
        )
    return contents


def _check_last_checkpoint(run: Run, folder: Path) -> None:
    """Raise `ResumeError` if a training would restart although its epochs have been tracked."""
    last = folder / LAST_CHECKPOINT
    if not last.exists() and any(name.startswith("validation/") for name in run.data.metrics):
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


def _enter_working_folder(run: Run, *, trust: bool) -> None:
    """Change to the working folder of the run, where its relative paths begin and, if trusted, its own classes are."""
    folder, left = _tag(run, WORKING_FOLDER_TAG), str(Path.cwd())
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

"""Resume a trial's training that an earlier attempt has begun."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from armscan.agents import Learner
from armscan.config.defaults import to_plain
from armscan.errors import CheckpointError, TrackingError, TrackingUnavailableError
from armscan.experiment.build import RunSetup, set_up
from armscan.experiment.job import Invocation
from armscan.experiment.provenance import place_tags, start_tracking, volume_tags
from armscan.sweeps.tasks.attempt import Attempt
from armscan.sweeps.tasks.folders import seed_folder
from armscan.tracking import TrackedRun, TrackingStore, open_store, run_of_study, take_over
from armscan.tracking.tags import PARENT_TAG, STUDY_TAG, VALIDATION_PREFIX
from armscan.training import EpochReport, resume_from_checkpoint
from armscan.utils.files import atomic_write
from armscan.utils.log import log
from armscan.utils.retry import RETRY_S
from armscan.utils.run_files import LAST_CHECKPOINT, RUN_FILE, folder_lock

if TYPE_CHECKING:
    from mlflow.entities import Run


def adopt(attempt: Attempt, seed: int) -> None:
    """Move a finished training of an earlier attempt to this one: its files, and its run below that of the trial."""
    folder = seed_folder(attempt.folder, seed)
    if (folder / RUN_FILE).exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    with folder_lock(folder):
        config, _ = attempt.config(seed)
        if found := _begun(folder, attempt, config):
            store, run = found
            for tag, value in _tags_of(attempt, folder).items():
                store.set_tag(run.info.run_id, tag, value)


def _tags_of(attempt: Attempt, folder: Path) -> dict[str, str]:
    """Return the tags of a training that say where it belongs."""
    return {**place_tags(folder), **attempt.tags, PARENT_TAG: attempt.run_id}


def start_or_resume(
    attempt: Attempt, setup: RunSetup, config: DictConfig, choices: dict[str, str], folder: Path
) -> tuple[RunSetup, TrackedRun, list[EpochReport] | None]:
    """Open the tracked run of a training, and restore the agent as an earlier attempt left it.

    Returns:
        The setup of the run, the tracked run, and the reports of the epochs so far; None if none has ended.
    """
    agent = setup.agent
    assert isinstance(agent, Learner)
    if found := _begun(folder, attempt, config):
        store, run = found
        tags = volume_tags(setup) | _tags_of(attempt, folder)
        reopen = partial(TrackedRun.reopen, store, run, folder=folder, config=to_plain(config), tags=tags)
        if (folder / LAST_CHECKPOINT).exists():
            try:
                earlier = resume_from_checkpoint(agent, folder, setup.provenance(run.info.run_id))
            except CheckpointError:
                # The trial can always start again, with an untrained agent.
                setup = set_up(config)
            else:
                return setup, reopen(), earlier
        elif not any(name.startswith(VALIDATION_PREFIX) for name in run.data.metrics):
            # It was interrupted before the end of its first epoch.
            return setup, reopen(), None
    invocation = Invocation(folder, attempt.overrides, attempt.command, choices)
    tracked = start_tracking(config, invocation, setup, parent_id=attempt.run_id, tags=attempt.tags, retry_s=RETRY_S)
    atomic_write(folder / RUN_FILE, json.dumps({"run_id": tracked.run_id}))
    return setup, tracked, None


def _begun(folder: Path, attempt: Attempt, config: DictConfig) -> tuple[TrackingStore, Run] | None:
    """Return the tracked run of a training, with its store, after taking it over from an earlier attempt."""
    if found := _begun_in(folder, attempt, config):
        return found
    for before in attempt.folders_before:
        if found := _begun_in(before / folder.name, attempt, config):
            _take_over(found[1].info.run_id, before / folder.name, folder)
            return found
    return None


def _begun_in(folder: Path, attempt: Attempt, config: DictConfig) -> tuple[TrackingStore, Run] | None:
    """Return the tracked run that this study has begun in a folder, with its store; None if there is none.

    A study of the same name may have left its files there: one in another storage, or one that was deleted.
    """
    if not (file := folder / RUN_FILE).exists():
        return None
    store, experiment_id = open_store(**to_plain(config.tracking), retry_s=RETRY_S)
    known = partial(run_of_study, store, experiment_id=experiment_id, where=str(file))
    tags = {STUDY_TAG: attempt.tags[STUDY_TAG], "seed": str(config.seed)}
    try:
        run = known(json.loads(file.read_text())["run_id"], tags=tags)
        # An earlier attempt had another trial number and another run of the trial, but below the same run of the study.
        study_run_id = store.get_run(attempt.run_id).data.tags[PARENT_TAG]
        known(run.data.tags.get(PARENT_TAG, ""), tags={PARENT_TAG: study_run_id})
    except TrackingUnavailableError:
        raise
    except TrackingError as error:
        log(f"trial {attempt.trial.number} does not resume from {folder}: {error}")
        return None
    return store, run


def _take_over(run_id: str, before: Path, folder: Path) -> None:
    """Copy the files of the earlier attempt."""
    for file in before.iterdir():
        if file.is_file() and not file.name.startswith(".") and file.name != RUN_FILE:
            shutil.copyfile(file, folder / file.name)
    take_over(run_id, before, folder)
    # Last: from then on this folder takes precedence.
    shutil.copyfile(before / RUN_FILE, folder / RUN_FILE)

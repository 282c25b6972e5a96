"""The tracked run of a trial: a worker opens it when the trial begins, and closes it when the trial is requeued."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from optuna.trial import Trial

from armscan.sweeps.scheduling.claim import PendingWrites
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.attribute_names import RETRY_OF, RUN
from armscan.sweeps.study.dashboard import note_run
from armscan.sweeps.study.phase import Phase
from armscan.sweeps.tasks.attempt import trial_folder
from armscan.tracking import TrackedRun, run_of_study
from armscan.tracking.tags import FOLDER_TAG, OVERRIDES_TAG, PARENT_TAG, STUDY_TAG, TRIAL_TAG
from armscan.utils.run_files import CONFIG_FILE, SHA256_TAGS


def open_run(
    phase: Phase, trial: Trial, values: Mapping[str, Any], config_sha256: str, writes: PendingWrites
) -> TrackedRun:
    """Start the tracked run of a trial, or resume that of a requeued one.

    Args:
        phase: Phase of the trial.
        trial: The trial.
        values: Its values by their keys.
        config_sha256: SHA-256 of its configuration.
        writes: Pending writes about the trial, to which a new run's note and ID are added.

    Returns:
        The open run.
    """
    attributes, folder = trial.user_attrs, trial_folder(phase.folder, trial.number)
    tags = {
        **phase.tags_of(trial),
        SHA256_TAGS[CONFIG_FILE]: config_sha256,
        FOLDER_TAG: str(folder.resolve()),
        OVERRIDES_TAG: " ".join(overrides_of(values)),
    }
    if RETRY_OF in attributes:
        tags["trial.retry_of"] = str(attributes[RETRY_OF])
    if RUN in attributes:
        run = run_of_study(
            phase.store,
            attributes[RUN],
            experiment_id=phase.experiment_id,
            tags={STUDY_TAG: phase.name, TRIAL_TAG: str(trial.number), PARENT_TAG: phase.run_id},
            where=f"{phase.name}.trials[{trial.number}].user_attrs.{RUN}",
        )
        return TrackedRun.reopen(phase.store, run, folder=folder, config={}, tags=tags)
    tracked = TrackedRun.start(
        phase.store,
        phase.experiment_id,
        name=f"{phase.name}-{trial.number:04d}",
        config=values,
        tags=tags,
        folder=folder,
        parent_id=phase.run_id,
    )
    # Before the trial's run ID is written: a trial that has one writes no note.
    writes.append(partial(note_run, trial, phase.store, phase.experiment_id, tracked.run_id, folder))
    writes.append(partial(trial.set_user_attr, RUN, tracked.run_id))
    return tracked


def close_requeued(*runs: TrackedRun | None) -> None:
    """Close the open runs of a trial that is requeued; None for no run."""
    for run in filter(None, runs):
        run.end_requeued()

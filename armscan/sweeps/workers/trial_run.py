"""The tracked run of a trial: a worker opens it when the trial begins, and ends it with the trial."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.sweeps.scheduling.claim import PendingWrites
from armscan.sweeps.space.parameter import overrides_of
from armscan.sweeps.storage.attribute_names import METRICS, RETRY_OF, RUN
from armscan.sweeps.study.dashboard import named_as_of_runs, note_run
from armscan.sweeps.study.phase import Phase
from armscan.sweeps.tasks.folders import trial_folder
from armscan.tracking import TrackedRun, run_of_study
from armscan.tracking.sync import PROCESS_DIED
from armscan.tracking.tags import (
    FAILURE_TAG,
    FOLDER_TAG,
    OVERRIDES_TAG,
    PARENT_TAG,
    SELECTION_PREFIX,
    STUDY_TAG,
    TRIAL_TAG,
    VALIDATION_PREFIX,
)
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


def end_run(
    phase: Phase,
    tracked: TrackedRun,
    trial: Trial | FrozenTrial,
    state: TrialState,
    metrics: Mapping[str, float],
    reason: str | None = None,
) -> None:
    """Track the outcome of a trial, and end its run.

    Args:
        phase: Phase of the trial.
        tracked: Run of the trial.
        trial: The trial.
        state: Its final state.
        metrics: Its metrics; empty if it was pruned or has failed.
        reason: Why it has failed. Default: None, it has not.
    """
    prefix = SELECTION_PREFIX if phase.population is None else VALIDATION_PREFIX
    named = named_as_of_runs(metrics, len(phase.seeds_of(trial)), prefix)
    tracked.log_metrics({**metrics, **named}, n_env_steps=0)
    if state == TrialState.PRUNED:
        tracked.set_pruned()
    tracked.end("FAILED" if reason else "FINISHED", reason=reason)


def end_runs_left_open(phase: Phase) -> None:
    """Track the outcomes of finished trials whose workers died after the storage had them, and end their runs."""
    finished = {trial.user_attrs.get(RUN): trial for trial in phase.scheduler.state().finished}
    died = f"tags.{STUDY_TAG} = '{phase.name}' AND tags.{FAILURE_TAG} = '{PROCESS_DIED}'"
    for run in phase.store.runs([phase.experiment_id], died):
        if (trial := finished.get(run.info.run_id)) is not None:
            folder = trial_folder(phase.folder, trial.number)
            tracked = TrackedRun.open_existing(phase.store, run.info.run_id, name=run.info.run_name, folder=folder)
            tracked.resume()
            end_run(phase, tracked, trial, trial.state, trial.user_attrs.get(METRICS, {}))
            phase.remove_checkpoints(trial)


def close_requeued(*runs: TrackedRun | None) -> None:
    """Close the open runs of a trial that is requeued; None for no run."""
    for run in filter(None, runs):
        run.end_requeued()

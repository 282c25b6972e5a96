"""`armscan runs stop`: ask the workers of a study to end a trial, or the study.

They do so at their first report after a heartbeat.
"""

from __future__ import annotations

import getpass
from collections.abc import Collection
from datetime import datetime

import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import TrialState

from armscan.errors import StudyError
from armscan.sweeps.storage.attribute_names import FINALIST, LEASE, RUN, STOP, STUDY_RUN
from armscan.sweeps.storage.attributes import FINAL_SUFFIXES
from armscan.sweeps.storage.storage import Storage, existing_storage, open_storage
from armscan.sweeps.study.study import is_ours
from armscan.utils.text import counted

NOT_ALONE = (
    "a training of the final evaluation cannot be stopped alone, because that would decide the result: stop the study"
)
STOPPED_BY = "at {:%Y-%m-%d %H:%M:%S} by {}"


def reason() -> str:
    """Return the time, and the user who requests the stop."""
    return STOPPED_BY.format(datetime.now(), getpass.getuser())


def is_study(storage: Storage | None, name: str) -> bool:
    """Return whether a study of armscan has this name; the studies of its final trainings do not count."""
    study = storage.study(name) if storage is not None else None
    return study is not None and is_ours(study)


def check_tracked(uri: str, name: str, number: int | None, *, runs: Collection[str], stored_in: str | None) -> None:
    """Raise `StudyError` if a study or a trial has noted another run: a study elsewhere may have the same name.

    Args:
        uri: Storage that was given.
        name: Name of the study.
        number: Number of the trial; None for the study.
        runs: Run IDs, one of which it must have noted, if it has noted any.
        stored_in: Storage that the run names.
    """
    study = optuna.load_study(study_name=name, storage=_storage_with(uri, name).optuna)
    noted = study.user_attrs.get(STUDY_RUN)
    if number is not None:
        trials = study.get_trials(deepcopy=False)
        noted = trials[number].user_attrs.get(RUN) if number < len(trials) else None
    if noted is not None and noted not in runs:
        raise StudyError(
            f"the study {name} in {uri!r} is not the one of this run, which is in {stored_in or 'another storage'}: "
            "give that with --storage"
        )


def stop_study(uri: str, name: str) -> str:
    """Stop a study: its trials are requeued, and its command resumes it; return the consequence in one line."""
    storage = _storage_with(uri, name)
    n_running = 0
    for each in (name, *(name + suffix for suffix in FINAL_SUFFIXES)):
        if (study := storage.study(each)) is not None:
            study.set_user_attr(STOP, reason())
            n_running += len(study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)))
    if not n_running:
        return f"study {name}: no trial is running; the command that started it resumes it, unless it has ended"
    return (
        f"study {name}: {counted(n_running, 'running trial')} will be requeued within ten seconds and an epoch; "
        "the command that started it resumes it"
    )


def stop_trial(uri: str, name: str, number: int) -> str:
    """Stop a trial of a study: it ends as pruned, and counts as finished; return the consequence in one line.

    Args:
        uri: Storage of the study.
        name: Name of the study.
        number: Number of the trial.

    Raises:
        StudyError: If there is no such trial, it has ended, or it is a training of the final evaluation.
    """
    if name.endswith(FINAL_SUFFIXES):
        raise StudyError(f"the run belongs to {name}, but {NOT_ALONE}")
    storage = _storage_with(uri, name)
    trials = optuna.load_study(study_name=name, storage=storage.optuna).get_trials(deepcopy=False)
    if number >= len(trials):
        raise StudyError(f"the trial is {number}, but study {name} has {len(trials)} trials")
    try:
        storage.optuna.set_trial_user_attr(trials[number]._trial_id, STOP, reason())
    except UpdateFinishedTrialError as error:
        ended = trials[number].state.name.lower()
        raise StudyError(f"trial {number} of study {name} has ended already ({ended})") from error
    return f"trial {number} of study {name} will end within ten seconds and an epoch, as pruned; it counts as finished"


def stop_running_trial(storage: Storage, trial_id: int) -> bool:
    """Stop a trial by its ID in the storage; return False, and do nothing, unless an armscan worker runs it.

    Raises:
        StudyError: If it is a training of the final evaluation.
    """
    try:
        trial = storage.optuna.get_trial(trial_id)
        if FINALIST in trial.user_attrs:
            raise StudyError(NOT_ALONE)
        if trial.state != TrialState.RUNNING or LEASE not in trial.user_attrs:
            return False
        storage.optuna.set_trial_user_attr(trial_id, STOP, reason())
    # It has ended in the meantime, or does not exist.
    except (KeyError, UpdateFinishedTrialError):
        return False
    return True


def _storage_with(uri: str, name: str) -> Storage:
    """Open a storage that has a study, for writing; create nothing if it has none."""
    there = existing_storage(uri, where="--storage")
    if there is None or name not in there.study_names:
        raise StudyError(f"the study is {name!r}, but it is not in {uri!r}: give --storage URI")
    return open_storage(uri, where="--storage")

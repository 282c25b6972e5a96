"""Retry of a trial whose worker died."""

from __future__ import annotations

from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from armscan.config.legacy import renamed
from armscan.sweeps.scheduling.state import StudyState, env_steps_of
from armscan.sweeps.storage.attribute_names import (
    ATTEMPT,
    ENV_STEPS,
    FAILURE,
    KEPT_BY_RETRY,
    LEASE,
    RETRIED,
    RETRY_OF,
)
from armscan.sweeps.storage.reports import reports_of, store_report

# Optuna's system attributes: the values of an enqueued trial, and the prefix of those that its halving pruners write.
FIXED_PARAMS, RUNG = "fixed_params", "completed_rung_"


def fail_and_retry(study: optuna.Study, trial: FrozenTrial, state: StudyState, *, max_retries: int) -> None:
    """Fail a trial whose worker died, and enqueue its retry if one is left; call it under the storage's lock.

    Args:
        study: The study.
        trial: The trial.
        state: State of the study.
        max_retries: Number of retries of a trial.
    """
    attempt, lease = trial.user_attrs.get(ATTEMPT, 0), trial.user_attrs.get(LEASE, {})
    reason = f"its worker died: {lease.get('worker', 'unknown')} on {lease.get('host', 'an unknown host')}"
    attributes: dict[str, Any] = {FAILURE: reason, ENV_STEPS: env_steps_of(trial)}
    if attempt < max_retries:
        attributes[RETRIED] = True
        # First, so that a death before the trial has failed loses nothing: the next worker finds the retry.
        if not any(other.user_attrs.get(RETRY_OF) == trial.number for other in state.all):
            kept = {name: value for name, value in trial.user_attrs.items() if name in KEPT_BY_RETRY}
            of_retry = kept | {RETRY_OF: trial.number, ATTEMPT: attempt + 1}
            # With the values that it was enqueued with: its worker may have died before it sampled them.
            params = {**trial.system_attrs.get(FIXED_PARAMS, {}), **trial.params}
            study.enqueue_trial(renamed(params), user_attrs=of_retry)
        _copy_reports(study, trial)
    for name, value in attributes.items():
        study._storage.set_trial_user_attr(trial._trial_id, name, value)
    study._storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)


def _copy_reports(study: optuna.Study, trial: FrozenTrial) -> None:
    """Copy the reports of a trial to its retry, which does not repeat the seeds that had finished."""
    waiting = study.get_trials(deepcopy=False, states=(TrialState.WAITING,))
    if not (retries := [each for each in waiting if each.user_attrs.get(RETRY_OF) == trial.number]):
        return
    storage, trial_id = study._storage, retries[0]._trial_id
    for step, values in reports_of(trial).items():
        store_report(storage, trial_id, step, values)
    for name, value in trial.system_attrs.items():
        if name.startswith(RUNG):
            storage.set_trial_system_attr(trial_id, name, value)

"""Trial scheduler: claims, requeues, retries after a worker's death, and the limits of a study.

It decides from what is in the storage, one process at a time, and keeps nothing in memory that a worker's death loses.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.config.legacy import renamed
from armscan.sweeps.scheduling.outcome import PendingWrites, TrialOutcome
from armscan.sweeps.scheduling.state import (
    ATTEMPT,
    ENV_STEPS,
    FAILURE,
    HOLDER,
    KEPT_BY_RETRY,
    LEASE,
    RESET_FAILURES,
    RETRIED,
    RETRY_OF,
    StudyState,
    env_steps_of,
)
from armscan.sweeps.storage.storage import Storage

# So many failures before any trial reported are the fault of the configuration.
FAILURES_AT_ONCE = 3


@dataclass(frozen=True, kw_only=True)
class Limits:
    """When a study ends.

    Args:
        n_trials: number of trials that finish.
        max_failures: failed trials, retried ones not counted, after which the study ends.
        max_retries: retries of a trial whose worker died.
        hours: wall time in which trials run; None for no limit.
        env_steps: environment steps of all trials; None for no limit.
    """

    n_trials: int
    max_failures: int = 10
    max_retries: int = 1
    hours: float | None = None
    env_steps: int | None = None

    def spent(self, state: StudyState) -> str | None:
        """Return which of time and environment steps is spent, so that running trials stop; None if neither is."""
        if self.hours is not None and state.busy_hours >= self.hours:
            return f"the {self.hours:g} hours of study.timeout_hours are over"
        if self.env_steps is not None and state.env_steps >= self.env_steps:
            return f"the {self.env_steps} environment steps of study.max_env_steps are taken"
        return None

    def broken(self, state: StudyState, reset: Collection[int]) -> str | None:
        """Return why failures end the study; None if they do not.

        Args:
            state: of the study.
            reset: numbers of trials whose failures are ignored.
        """
        failed = [trial for trial in state.failed if trial.number not in reset]
        if len(failed) > self.max_failures:
            return f"{len(failed)} trials have failed, and at most {self.max_failures} may: {_reason(failed[-1])}"
        got_nowhere = not state.finished and not any(trial.intermediate_values for trial in state.all)
        if len(failed) >= FAILURES_AT_ONCE and got_nowhere:
            return f"the first {len(failed)} trials failed before they reported anything: {_reason(failed[0])}"
        return None


def _reason(trial: FrozenTrial) -> str:
    return f"trial {trial.number}: {trial.user_attrs.get(FAILURE, 'no reason is known')}"


T = TypeVar("T")


class TrialScheduler:
    """Scheduler of the trials of a study.

    Args:
        study: in its storage.
        storage: the same.
        limits: when the study ends.
        is_open: whether new trials are made; otherwise only enqueued ones are run.
    """

    def __init__(self, study: optuna.Study, storage: Storage, limits: Limits, *, is_open: bool = True) -> None:
        self.study = study
        self._storage = storage
        self._limits = limits
        self._is_open = is_open

    def state(self) -> StudyState:
        """Return the state of the study."""
        return StudyState.of(self.study.get_trials(deepcopy=False))

    def transaction(self, operate: Callable[[], T]) -> T:
        """See `Storage.transaction`."""
        return self._storage.transaction(operate)

    def claim(self, lease: Mapping[str, Any], outcome: TrialOutcome | None = None) -> Trial | None:
        """Tell the outcome of a trial, and claim the next: a waiting one if there is one, else a new one.

        Args:
            lease: of the worker that claims it.
            outcome: of the worker's trial before, if any; its `is_told` is set.

        Returns:
            The trial; None if there is none now, because enough are running or the study has ended.
        """
        asked: list[Trial] = []
        n_times = 0

        def claimed() -> Trial | None:
            nonlocal n_times
            n_times += 1
            if outcome is not None:
                self._tell(outcome, is_repeated=n_times > 1)
            state = self.state()
            # If the storage went away in the middle, one may have been claimed before, and only the answer been lost.
            leases = {trial._trial_id: trial.user_attrs.get(LEASE) for trial in state.running}
            for trial in asked:
                if leases.get(trial._trial_id) == lease:
                    return trial
            if not self.has_more(state):
                return None
            asked.append(self.study.ask())
            asked[-1].set_user_attr(LEASE, dict(lease))
            return asked[-1]

        return self._storage.exclusive(claimed)

    def _tell(self, outcome: TrialOutcome, *, is_repeated: bool) -> None:
        trial = outcome.trial
        now = self.study._storage.get_trial(trial._trial_id).state
        if now != TrialState.RUNNING:
            # Others end a worker's trial only as failed; or it was this worker, and the answer was lost.
            outcome.is_told = is_repeated and now == outcome.state
            return
        for name, value in outcome.attributes.items():
            trial.set_user_attr(name, value)
        outcome.writes.write()
        self.study.tell(trial, outcome.values, outcome.state)
        outcome.is_told = True

    def has_more(self, state: StudyState) -> bool:
        """Whether a trial can be claimed now."""
        enough = len(state.finished) + len(state.running) >= self._limits.n_trials
        return not enough and self.end(state) is None and (self._is_open or bool(state.waiting))

    def end(self, state: StudyState) -> str | None:
        """Return why no further trial is claimed; None while trials are missing."""
        limits = self._limits
        if len(state.finished) >= limits.n_trials:
            return f"{len(state.finished)} trials have finished"
        if broken := self.broken(state):
            return broken
        if not self._is_open and not state.waiting:
            return f"{len(state.finished)} trials have finished, {len(state.failed)} failed"
        return self.spent(state)

    def spent(self, state: StudyState) -> str | None:
        """See `Limits.spent`."""
        return self._limits.spent(state)

    def broken(self, state: StudyState) -> str | None:
        """See `Limits.broken`; failures before the last restart are ignored."""
        reset = self.study.user_attrs.get(RESET_FAILURES, ()) if state.failed else ()
        return self._limits.broken(state, reset)

    def reset_failures(self) -> int:
        """Ignore the failures so far if they have ended the study, because it is started again.

        Returns:
            How many there were; 0 if they have not ended it.
        """
        state = self.state()
        if self.broken(state) is None:
            return 0
        self.study.set_user_attr(RESET_FAILURES, [trial.number for trial in state.failed])
        return len(state.failed)

    def requeue(self, trial: Trial, lease: Mapping[str, Any], writes: PendingWrites | None = None) -> None:
        """Requeue a worker's own trial, for any worker to resume.

        Args:
            trial: the trial.
            lease: of the worker, with the trial's progress.
            writes: about the trial, still pending.
        """
        storage = self.study._storage
        # No process: a worker that claims it and dies before writing its lease must not be taken for this one.
        left = {**lease, "started": ""}

        def requeue() -> None:
            now = storage.get_trial(trial._trial_id)
            holder = now.user_attrs.get(LEASE, {})
            is_own = all(holder.get(key) == lease[key] for key in HOLDER if key in lease)
            # Not if this worker was taken for dead, nor if only the answer was lost and another has claimed it since.
            if now.state == TrialState.RUNNING and is_own:
                if writes is not None:
                    writes.write()
                storage.set_trial_user_attr(trial._trial_id, LEASE, left)
                storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)

        self._storage.exclusive(requeue)

    def renew(self, trial: Trial | None, lease: Mapping[str, Any], *, is_checking: bool = True) -> StudyState | None:
        """Renew the lease of a worker's trial.

        Args:
            trial: None if the worker has none.
            lease: of the worker, with the trial's progress.
            is_checking: whether to return the state of the study.

        Returns:
            The state of the study; None without `is_checking`.
        """

        def renewed() -> StudyState | None:
            # A worker that was taken for dead has lost its trial.
            with contextlib.suppress(UpdateFinishedTrialError):
                if trial is not None:
                    self.study._storage.set_trial_user_attr(trial._trial_id, LEASE, dict(lease))
            return self.state() if is_checking else None

        return self.transaction(renewed)

    def reclaim(self, is_dead: Callable[[FrozenTrial], bool], seen: StudyState | None = None) -> list[FrozenTrial]:
        """Fail the trials of dead workers, and enqueue a retry of each that has one left.

        Args:
            is_dead: whether the worker of a running trial is dead.
            seen: state of the study a moment ago; default: read now.

        Returns:
            The trials that were failed.
        """

        def is_lost(trial: FrozenTrial) -> bool:
            # A claim writes the lease before others can see the trial.
            return LEASE not in trial.user_attrs or is_dead(trial)

        # First without the lock: hardly ever is a trial lost.
        if not any(map(is_lost, (seen or self.state()).running)):
            return []
        reclaimed: dict[int, FrozenTrial] = {}

        def reclaim() -> None:
            state = self.state()
            for trial in state.running:
                if is_lost(trial) and self._reclaimed(trial, state):
                    reclaimed[trial.number] = trial

        self._storage.exclusive(reclaim)
        return list(reclaimed.values())

    def _reclaimed(self, trial: FrozenTrial, state: StudyState) -> bool:
        attempt = trial.user_attrs.get(ATTEMPT, 0)
        lease = trial.user_attrs.get(LEASE, {})
        reason = f"its worker died: {lease.get('worker', 'unknown')} on {lease.get('host', 'an unknown host')}"
        is_retried = attempt < self._limits.max_retries
        # First, so that a death between the two loses nothing: the next worker finds it.
        if is_retried and not any(other.user_attrs.get(RETRY_OF) == trial.number for other in state.all):
            kept = {name: value for name, value in trial.user_attrs.items() if name in KEPT_BY_RETRY}
            of_retry = kept | {RETRY_OF: trial.number, ATTEMPT: attempt + 1}
            self.study.enqueue_trial(renamed(trial.params), user_attrs=of_retry)
        attributes: dict[str, Any] = {FAILURE: reason, ENV_STEPS: env_steps_of(trial)}
        return self._fail(trial._trial_id, attributes | ({RETRIED: True} if is_retried else {}))

    def _fail(self, trial_id: int, attributes: Mapping[str, Any]) -> bool:
        storage = self.study._storage
        try:
            for name, value in attributes.items():
                storage.set_trial_user_attr(trial_id, name, value)
            return storage.set_trial_state_values(trial_id, TrialState.FAIL)
        except UpdateFinishedTrialError:
            return False

"""Trial scheduler: claims, requeues, and retries after a worker's death.

It decides from the storage alone, one process at a time, so a worker's death loses nothing.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.sweeps.scheduling.claim import ClaimStatus, PendingWrites, PlannedTrial, TrialOutcome
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.retry import fail_and_retry
from armscan.sweeps.scheduling.state import BEAT_S, StudyState
from armscan.sweeps.scheduling.termination import Termination
from armscan.sweeps.storage.attribute_names import (
    DROPPED,
    EARLIER_SPANS,
    FAILURE,
    HOLDER,
    LEASE,
    RESET_FAILURES,
    RETRIED,
    STOP,
)
from armscan.sweeps.storage.storage import Storage

# Why a waiting trial was dropped.
NOT_NEEDED = "the study no longer needs it: its configuration, or its candidates, have changed"
Plan = Callable[[], Sequence[PlannedTrial]]


class TrialScheduler:
    """Scheduler of the trials of a study.

    Args:
        study: The study in its storage.
        storage: The storage.
        limits: Limits at which the study ends.
        plan: Function that returns the trials to enqueue next, derived from the storage. Default: None, Optuna's
            sampler proposes the trials.
        termination: Ends the study before its last trial. Default: None, nothing does.
        is_current: Function that returns whether the failure of a trial counts. Default: None, all do.
        unwanted: Function that returns those of the waiting trials that are no longer needed, and are not run.
            Default: None, all are needed.
    """

    def __init__(
        self,
        study: optuna.Study,
        storage: Storage,
        limits: Limits,
        plan: Plan | None = None,
        *,
        termination: Termination | None = None,
        is_current: Callable[[FrozenTrial], bool] | None = None,
        unwanted: Callable[[Sequence[FrozenTrial]], Sequence[FrozenTrial]] | None = None,
    ) -> None:
        self.study, self.storage = study, storage
        self.limits, self._plan = limits, plan
        self._is_current, self._unwanted = is_current, unwanted
        self.termination = termination
        # When and by whom the study was stopped, as far as this process knows; see `read_stop_request`.
        self.stopped = ""

    def state(self) -> StudyState:
        """Return the state of the study."""
        return StudyState.of(self.study.get_trials(deepcopy=False))

    def claim(self, lease: Mapping[str, Any], outcome: TrialOutcome | None = None) -> Trial | None:
        """Tell Optuna the outcome of a trial, and claim the next: a waiting one if there is one, else a new one.

        Args:
            lease: Lease of the worker that claims the trial.
            outcome: Outcome of the worker's previous trial, whose `is_told` is set. Default: None, there is none.

        Returns:
            The trial; None if there is none now, because enough are running or the study has ended.
        """
        is_repeated = False

        def claimed() -> Trial | None:
            nonlocal is_repeated
            if outcome is not None:
                self._tell(outcome, is_repeated=is_repeated)
            self._drop_waiting()
            state = self.state()
            # If the storage became unavailable midway, a trial may have been claimed, and only the reply lost.
            own = [trial for trial in state.running if is_repeated and trial.user_attrs.get(LEASE) == lease]
            is_repeated = True
            if own:
                return Trial(self.study, own[0]._trial_id)
            status = self.claim_status(state)
            if not status.can_claim:
                return None
            for planned in status.planned:
                self.study.enqueue_trial(dict(planned.params), user_attrs=dict(planned.attributes))
            trial = self.study.ask()
            trial.set_user_attr(LEASE, dict(lease))
            return trial

        return self.storage.exclusive(claimed)

    def _drop_waiting(self) -> None:
        """Fail the waiting trials that are no longer needed; they count nowhere."""
        if self._unwanted is None:
            # A search reads its trials only once for a claim.
            return
        for trial in self._unwanted(self.state().waiting):
            for name, value in ((RETRIED, True), (DROPPED, True), (FAILURE, NOT_NEEDED)):
                self.study._storage.set_trial_user_attr(trial._trial_id, name, value)
            self.study._storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)

    def _tell(self, outcome: TrialOutcome, *, is_repeated: bool) -> None:
        trial = outcome.trial
        now = self.study._storage.get_trial(trial._trial_id).state
        if now != TrialState.RUNNING:
            # Other workers can only fail this trial; any other state was told by this one, and the reply was lost.
            outcome.is_told = is_repeated and now == outcome.state
            return
        for name, value in outcome.attributes.items():
            trial.set_user_attr(name, value)
        outcome.writes.write()
        self.study.tell(trial, outcome.values, outcome.state)
        outcome.is_told = True

    def claim_status(self, state: StudyState) -> ClaimStatus:
        """Return whether a trial can be claimed now, and whether one ever will be."""
        if reason := self._early_end_reason(state):
            return ClaimStatus(reason)
        is_enough = len(state.finished) + len(state.running) >= self.limits.n_trials
        planned = () if is_enough or self._plan is None or state.waiting else self._plan()
        has_next = not is_enough and (self._plan is None or bool(state.waiting or planned))
        # The outcome of a running trial may lead to another one.
        if not has_next and not state.running:
            return ClaimStatus(f"{len(state.finished)} trials have finished, {len(state.failed)} failed")
        reason = self.limits.limit_reason(state)
        return ClaimStatus(reason, can_claim=has_next and reason is None, planned=planned)

    def end_reason(self, state: StudyState) -> str | None:
        """Return why no further trial is claimed; None while trials are missing."""
        return self.claim_status(state).end_reason

    def _early_end_reason(self, state: StudyState) -> str | None:
        """Return why the study ends, whether or not trials are planned; None if it does not."""
        if len(state.finished) >= self.limits.n_trials:
            return f"{len(state.finished)} trials have finished"
        if reason := self.failure_reason(state):
            return reason
        if self.termination is not None and (reason := self.termination.reason):
            return reason
        return f"the study was stopped {self.stopped}" if self.stopped else None

    def failure_reason(self, state: StudyState) -> str | None:
        """See `Limits.failure_reason`; ignored failures do not count, see `reset_failures`."""
        return self.limits.failure_reason(state, self.failures(state))

    def check_termination(self, state: StudyState | None = None) -> None:
        """Check whether the study ends before its last trial; see `Termination.check`."""
        if self.termination is not None:
            self.termination.check(state or self.state())

    def read_stop_request(self) -> str:
        """Return when and by whom the study was stopped; an empty string if it was not."""
        self.stopped = str(self.study.user_attrs.get(STOP, ""))
        return self.stopped

    def resume(self) -> bool:
        """Resume a stopped study that is started again; return whether it was stopped."""
        was_stopped = bool(self.read_stop_request())
        if was_stopped:
            self.study.set_user_attr(STOP, "")
            self.stopped = ""
        return was_stopped

    def failures(self, state: StudyState) -> list[FrozenTrial]:
        """Return the failed trials that are not ignored."""
        reset = self.study.user_attrs.get(RESET_FAILURES, ()) if state.failed else ()
        failed = [trial for trial in state.failed if trial.number not in reset]
        return [*filter(self._is_current, failed)] if self._is_current else failed

    def reset_failures(self, *, is_blocked: bool = False) -> int:
        """Ignore the failures so far if they have ended the study, or block it, because it is started again.

        Args:
            is_blocked: Whether the study cannot go on with them. Default: False.

        Returns:
            The number of failures that are ignored from now on.
        """
        state = self.state()
        failures = self.failures(state)
        if not failures or not (is_blocked or self.failure_reason(state)):
            return 0
        self.study.set_user_attr(RESET_FAILURES, [trial.number for trial in state.failed])
        return len(failures)

    def requeue(self, trial: Trial, lease: Mapping[str, Any], writes: PendingWrites | None = None) -> None:
        """Requeue a worker's own trial, with its lease and pending writes, for any worker to resume."""
        storage, trial_id = self.study._storage, trial._trial_id

        def requeue() -> None:
            now = storage.get_trial(trial_id)
            holder = now.user_attrs.get(LEASE, {})
            is_own = all(holder.get(key) == lease[key] for key in HOLDER if key in lease)
            # Not if this worker was taken for dead, nor if only the reply was lost and another has claimed it since.
            if now.state == TrialState.RUNNING and is_own:
                (writes or PendingWrites()).write()
                assert now.datetime_start is not None
                # The next worker's claim overwrites the start.
                spans = [*now.user_attrs.get(EARLIER_SPANS, ()), (now.datetime_start.timestamp(), time.time())]
                storage.set_trial_user_attr(trial_id, EARLIER_SPANS, spans)
                # Names no process: a worker that dies between its claim and its lease must not be taken for this one.
                storage.set_trial_user_attr(trial_id, LEASE, {**lease, "started": "", BEAT_S: time.time()})
                storage.set_trial_state_values(trial_id, TrialState.WAITING)

        self.storage.exclusive(requeue)

    def renew(self, trial: Trial | None, lease: Mapping[str, Any], *, is_checking: bool = True) -> StudyState | None:
        """Renew the lease of a worker's trial.

        Args:
            trial: Trial of the worker; None if it has none.
            lease: Lease of the worker, with the trial's progress.
            is_checking: Whether to return the state of the study. Default: True.

        Returns:
            The state of the study; None without `is_checking`.
        """

        def renewed() -> StudyState | None:
            # A worker that was taken for dead has lost its trial.
            with contextlib.suppress(UpdateFinishedTrialError):
                if trial is not None:
                    self.study._storage.set_trial_user_attr(trial._trial_id, LEASE, dict(lease))
            if not is_checking:
                return None
            self.read_stop_request()
            return self.state()

        return self.storage.transaction(renewed)

    def reclaim(self, is_dead: Callable[[FrozenTrial], bool], seen: StudyState | None = None) -> list[FrozenTrial]:
        """Fail the trials of dead workers, enqueue a retry where one is left, and return the failed trials.

        Args:
            is_dead: Function that returns whether the worker of a running trial is dead.
            seen: Recent state of the study. Default: None, read it now.
        """

        def lost(state: StudyState) -> list[FrozenTrial]:
            # A claim writes the lease before others can see the trial.
            return [trial for trial in state.running if LEASE not in trial.user_attrs or is_dead(trial)]

        # First without the lock: trials are rarely lost.
        if not lost(seen or self.state()):
            return []
        reclaimed: dict[int, FrozenTrial] = {}

        def reclaim() -> None:
            state = self.state()
            for trial in lost(state):
                fail_and_retry(self.study, trial, state, max_retries=self.limits.max_retries)
                reclaimed[trial.number] = trial

        self.storage.exclusive(reclaim)
        return list(reclaimed.values())

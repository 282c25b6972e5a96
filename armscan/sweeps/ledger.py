"""Who runs which trial: what is claimed, handed back, taken up again after a death, and when there is enough.

All of it is decided from what stands in the storage, by one process at a time; nothing is kept in memory that a worker
could take with it when it dies.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.sweeps.limits import Limits
from armscan.sweeps.outcome import Notes, Outcome
from armscan.sweeps.storage import Storage
from armscan.sweeps.tally import (
    ATTEMPT,
    ENV_STEPS,
    FAILURE,
    FORGIVEN,
    HOLDER,
    KEPT_BY_RETRY,
    LEASE,
    RETRIED,
    RETRY_OF,
    Tally,
    env_steps_of,
)

T = TypeVar("T")


class Ledger:
    """The books of a study.

    Args:
        study: in its storage.
        storage: the same.
        limits: when it has enough.
        is_open: whether trials are made as they are wanted; otherwise only those are run that wait already.
    """

    def __init__(self, study: optuna.Study, storage: Storage, limits: Limits, *, is_open: bool = True) -> None:
        self.study = study
        self._storage = storage
        self._limits = limits
        self._is_open = is_open

    def tally(self) -> Tally:
        """Returns how the study stands."""
        return Tally.of(self.study.get_trials(deepcopy=False))

    def together(self, operate: Callable[[], T]) -> T:
        """See `Storage.together`."""
        return self._storage.together(operate)

    def claim(self, lease: Mapping[str, Any], outcome: Outcome | None = None) -> Trial | None:
        """Tells what came of a trial, and takes another to run, one that waits before a new one.

        Args:
            lease: who takes it.
            outcome: of the trial before; None where there is none to be told. It says then whether it was told.

        Returns:
            The trial, or None where there is none to be had now: those that run may be enough, or the study is over.
        """
        asked: list[Trial] = []
        n_times = 0

        def claimed() -> Trial | None:
            nonlocal n_times
            n_times += 1
            if outcome is not None:
                self._tell(outcome, is_repeated=n_times > 1)
            tally = self.tally()
            # Where the storage went away in the middle, one may have been taken before, and only the answer been lost.
            leases = {trial._trial_id: trial.user_attrs.get(LEASE) for trial in tally.running}
            for trial in asked:
                if leases.get(trial._trial_id) == lease:
                    return trial
            if not self.has_more(tally):
                return None
            asked.append(self.study.ask())
            asked[-1].set_user_attr(LEASE, dict(lease))
            return asked[-1]

        return self._storage.alone(claimed)

    def _tell(self, outcome: Outcome, *, is_repeated: bool) -> None:
        trial = outcome.trial
        now = self.study._storage.get_trial(trial._trial_id).state
        if now != TrialState.RUNNING:
            # Others end the trial of a worker only as failed; or it was this one, and the answer was lost.
            outcome.is_told = is_repeated and now == outcome.state
            return
        for name, value in outcome.attributes.items():
            trial.set_user_attr(name, value)
        outcome.notes.write()
        self.study.tell(trial, outcome.values, outcome.state)
        outcome.is_told = True

    def has_more(self, tally: Tally) -> bool:
        """Whether there is a trial to be had now."""
        enough = len(tally.finished) + len(tally.running) >= self._limits.n_trials
        return not enough and self.end(tally) is None and (self._is_open or bool(tally.waiting))

    def end(self, tally: Tally) -> str | None:
        """Returns why no further trial is to be begun; None where some are."""
        limits = self._limits
        if len(tally.finished) >= limits.n_trials:
            return f"{len(tally.finished)} trials have finished"
        if broken := self.broken(tally):
            return broken
        if not self._is_open and not tally.waiting:
            return f"{len(tally.finished)} trials have finished, {len(tally.failed)} failed"
        return self.spent(tally)

    def spent(self, tally: Tally) -> str | None:
        """See `Limits.spent`."""
        return self._limits.spent(tally)

    def broken(self, tally: Tally) -> str | None:
        """See `Limits.broken`; failures that were forgiven do not count."""
        forgiven = self.study.user_attrs.get(FORGIVEN, ()) if tally.failed else ()
        return self._limits.broken(tally, forgiven)

    def forgive(self) -> int:
        """Lets failures count no more, where there were too many: somebody starts the study again all the same.

        Returns:
            How many there were; 0 where the study goes on without.
        """
        tally = self.tally()
        if self.broken(tally) is None:
            return 0
        self.study.set_user_attr(FORGIVEN, [trial.number for trial in tally.failed])
        return len(tally.failed)

    def hand_back(self, trial: Trial, lease: Mapping[str, Any], notes: Notes | None = None) -> None:
        """Leaves a trial of one's own for another to go on with.

        Args:
            trial: that is left.
            lease: says how far it is.
            notes: of the trial, not written yet.
        """
        storage = self.study._storage
        # Nobody holds it: whoever takes it and dies before its own lease is there is not to be taken for this worker.
        left = {**lease, "started": ""}

        def handed_back() -> None:
            now = storage.get_trial(trial._trial_id)
            holder = now.user_attrs.get(LEASE, {})
            is_own = all(holder.get(key) == lease[key] for key in HOLDER if key in lease)
            # Not where somebody took this worker for dead, nor, where only the answer was lost, took it up already.
            if now.state == TrialState.RUNNING and is_own:
                if notes is not None:
                    notes.write()
                storage.set_trial_user_attr(trial._trial_id, LEASE, left)
                storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)

        self._storage.alone(handed_back)

    def renew(self, trial: Trial | None, lease: Mapping[str, Any], *, is_looking: bool = True) -> Tally | None:
        """Says that the worker of a trial of one's own is alive, and how far it is.

        Args:
            trial: None where the worker has none at hand.
            lease: of the trial.
            is_looking: whether to look how the study stands.

        Returns:
            How it stands; None where nobody looks.
        """

        def renewed() -> Tally | None:
            # Where somebody took the worker for dead, the trial is not its own any more.
            with contextlib.suppress(UpdateFinishedTrialError):
                if trial is not None:
                    self.study._storage.set_trial_user_attr(trial._trial_id, LEASE, dict(lease))
            return self.tally() if is_looking else None

        return self.together(renewed)

    def reclaim(self, is_dead: Callable[[FrozenTrial], bool], seen: Tally | None = None) -> list[FrozenTrial]:
        """Fails the trials of workers that have died, and lets each be taken up again where it may be.

        Args:
            is_dead: whether the worker of a running trial is.
            seen: how the study stood a moment ago; it is asked for where it is None.

        Returns:
            The trials that were failed.
        """

        def is_lost(trial: FrozenTrial) -> bool:
            # Who claims a trial gives it its lease before anybody else may look.
            return LEASE not in trial.user_attrs or is_dead(trial)

        # First without keeping others out: hardly ever is one lost.
        if not any(map(is_lost, (seen or self.tally()).running)):
            return []
        reclaimed: dict[int, FrozenTrial] = {}

        def reclaim() -> None:
            tally = self.tally()
            for trial in tally.running:
                if is_lost(trial) and self._reclaimed(trial, tally):
                    reclaimed[trial.number] = trial

        # Those of a first time, of which only the answer was lost, are among them.
        self._storage.alone(reclaim)
        return list(reclaimed.values())

    def _reclaimed(self, trial: FrozenTrial, tally: Tally) -> bool:
        attempt = trial.user_attrs.get(ATTEMPT, 0)
        lease = trial.user_attrs.get(LEASE, {})
        reason = f"its worker died: {lease.get('worker', 'unknown')} on {lease.get('host', 'an unknown host')}"
        is_retried = attempt < self._limits.max_retries
        # First, so that a death between the two loses nothing; whoever comes next finds it there.
        if is_retried and not any(other.user_attrs.get(RETRY_OF) == trial.number for other in tally.all):
            kept = {name: value for name, value in trial.user_attrs.items() if name in KEPT_BY_RETRY}
            self.study.enqueue_trial(trial.params, user_attrs=kept | {RETRY_OF: trial.number, ATTEMPT: attempt + 1})
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

"""Heartbeat of a worker: it renews the lease of its trial, and reclaims the trials of dead workers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from typing import Any

import optuna
from optuna.trial import FrozenTrial, Trial

from armscan.sweeps.scheduling.claim import PendingWrites, TrialOutcome
from armscan.sweeps.scheduling.limits import LimitReachedError
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import BEAT_S
from armscan.sweeps.storage.attribute_names import CODE, HOLDER, LEASE, STOP
from armscan.tracking import code_version
from armscan.utils.log import log
from armscan.utils.processes import ProcessInfo

HEARTBEAT_S, POLL_S = 10.0, 0.25
# A worker without a heartbeat for this long counts as dead; a busy storage may delay some heartbeats.
DEAD_AFTER_S = 40.0
# With up to this many running trials, each worker checks all of them at each heartbeat; with more it checks less often,
# because a check costs the storage some time for each running trial.
MAX_CHECKERS = 64
# A gap between two checks counts as at most this many expected intervals of silence: in a longer gap, the storage was
# unavailable to all workers, and none could renew its lease.
MAX_UNSEEN = 1.5
# Time in which a worker that leaves must requeue its trial. If the storage is unavailable for longer, the trial is
# reclaimed later, because its process is gone.
REQUEUE_TIMEOUT_S = 5.0
# Part of it: the longest wait for a tracked run that is being created. Requeued before the run's ID is stored, a trial
# would get a second run.
OPENING_TIMEOUT_S = 2.0


class LivenessCheck:
    """Tells dead workers from living ones, by its own clock, because the clocks of machines differ."""

    def __init__(self) -> None:
        # Expected time between two checks.
        self.interval_s = HEARTBEAT_S
        # By trial: its last heartbeat, when it was last checked, and for how long it had been the same by then.
        self._seen: dict[int, tuple[Any, float, float]] = {}

    def is_dead(self, trial: FrozenTrial) -> bool:
        """Return whether the worker of a running trial has ended, or has not renewed its lease for too long."""
        lease = trial.user_attrs.get(LEASE, {})
        holder = ProcessInfo.of(lease)
        if holder.is_here:
            return not holder.is_alive
        heartbeat = lease.get("worker"), lease.get("beat")
        now_s = time.monotonic()
        before, checked_s, silent_s = self._seen.get(trial.number, (None, now_s, 0.0))
        if before == heartbeat:
            silent_s += min(now_s - checked_s, MAX_UNSEEN * self.interval_s)
        else:
            silent_s = 0.0
        self._seen[trial.number] = heartbeat, now_s, silent_s
        return silent_s > DEAD_AFTER_S


class Heartbeat:
    """Renews the lease of the current trial, reclaims the trials of dead workers, and leaves when asked to.

    Args:
        scheduler: Scheduler of the study.
        worker: Name of this worker.
        should_leave: Function that is polled several times a second.
        leave: Function that ends the process, once the current trial is requeued; mostly called from another thread
            than the worker's.
        on_death: Function that is called with each reclaimed trial.
        should_leave_soon: Function that is polled when a trial is claimed and when it reports progress, where
            leaving loses nothing.
    """

    def __init__(
        self,
        scheduler: TrialScheduler,
        worker: str,
        *,
        should_leave: Callable[[], bool],
        leave: Callable[[], None],
        on_death: Callable[[FrozenTrial], None],
        should_leave_soon: Callable[[], bool] = lambda: False,
    ) -> None:
        self._lease: dict[str, Any] = {
            "worker": worker,
            CODE: code_version(),
            **asdict(ProcessInfo.current()),
            "beat": 0,
        }
        self._scheduler, self._liveness = scheduler, LivenessCheck()
        self._should_leave, self._leave, self._on_death = should_leave, leave, on_death
        self._should_leave_soon = should_leave_soon
        self._trial: Trial | None = None
        # Closes the open runs of the current trial if the process is told to leave.
        self.cleanup: Callable[[], None] | None = None
        self.writes = PendingWrites()
        self._limit: str | None = None
        # Whether somebody has asked for the end of the current trial.
        self._is_trial_stopped = False
        self._next_check_s = 0.0
        # Held while a trial is claimed or requeued, so that no trial is lost if the worker leaves in between.
        self._changing, self._cleaning = threading.Lock(), threading.Lock()
        # Held while the tracked run of the current trial is being opened.
        self.opening = threading.Lock()
        self._stopped = threading.Event()
        # Two: heartbeats wait for an unavailable storage, but leaving does not.
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._watch, self._beat)]

    @contextmanager
    def running(self) -> Iterator[None]:
        """Run the heartbeat inside the context."""
        for thread in self._threads:
            thread.start()
        try:
            yield
        finally:
            self._stopped.set()
            for thread in self._threads:
                thread.join()

    def claim(self, outcome: TrialOutcome | None = None, cleanup: Callable[[], None] | None = None) -> Trial | None:
        """Claim a trial as `TrialScheduler.claim` does, and hold it; `cleanup` is that of the previous trial."""
        with self._changing:
            # Drop the progress of the previous trial.
            self._lease = {key: self._lease[key] for key in (*HOLDER, "beat")} | {BEAT_S: time.time()}
            self._trial = self._scheduler.claim(self._lease, outcome)
            self.cleanup, self.writes = cleanup, PendingWrites()
            self._is_trial_stopped = False
        self._leave_if_told_to()
        return self._trial

    def clean_up(self) -> None:
        """Run the cleanup, once; another thread that calls this waits until it is done."""
        with self._cleaning:
            cleanup, self.cleanup = self.cleanup, None
            if cleanup is not None:
                cleanup()

    def report_progress(self, progress: dict[str, Any]) -> None:
        """Keep the trial's progress for the next renewal of the lease.

        Raises:
            LimitReachedError: If the study's time or environment steps are used up, or it was stopped.
            optuna.TrialPruned: If the trial was stopped.
        """
        self._lease = self._lease | progress
        self._leave_if_told_to()
        if self._is_trial_stopped:
            raise optuna.TrialPruned
        if self._limit is not None:
            raise LimitReachedError(self._limit)

    def requeue(self) -> None:
        """Requeue the current trial, if there is one."""
        with self._changing:
            if self._trial is not None:
                self._scheduler.requeue(self._trial, self._lease, self.writes)
                log(f"trial {self._trial.number} is requeued")
            self.clean_up()
            self._trial = None

    def _leave_if_told_to(self) -> None:
        if self._should_leave_soon():
            self.requeue()
            self._leave()

    def _watch(self) -> None:
        while not self._stopped.wait(POLL_S):
            is_told = False
            # A shared folder may be unavailable for a moment.
            with suppress(OSError):
                is_told = self._should_leave()
            if is_told:
                late = threading.Timer(REQUEUE_TIMEOUT_S, self._leave)
                late.daemon = True
                late.start()
                # Never released: this process must not open another run.
                self.opening.acquire(timeout=OPENING_TIMEOUT_S)
                try:
                    self.requeue()
                finally:
                    late.cancel()
                    self._leave()

    def _beat(self) -> None:
        while True:
            try:
                self._renew()
            # Any error of a storage that is unavailable for long: the next heartbeat may reach it again.
            except Exception as error:
                log(f"heartbeat failed: {error!r}")
            if self._stopped.wait(HEARTBEAT_S):
                return

    def _renew(self) -> None:
        with self._changing:
            self._lease = self._lease | {"beat": self._lease["beat"] + 1, BEAT_S: time.time()}
            is_checking = time.monotonic() >= self._next_check_s
            state = self._scheduler.renew(self._trial, self._lease, is_checking=is_checking)
            if state is None:
                return
            self._is_trial_stopped = any(trial.user_attrs.get(STOP) for trial in state.running if self._is_own(trial))
        self._liveness.interval_s = HEARTBEAT_S * max(1.0, len(state.running) / MAX_CHECKERS)
        # Half a heartbeat of tolerance, because heartbeats are never exactly on time.
        self._next_check_s = time.monotonic() + self._liveness.interval_s - HEARTBEAT_S / 2
        for trial in self._scheduler.reclaim(self._liveness.is_dead, state):
            self._on_death(trial)
        stopped = self._scheduler.stopped
        self._limit = f"the study was stopped {stopped}" if stopped else self._scheduler.limits.limit_reason(state)

    def _is_own(self, trial: FrozenTrial) -> bool:
        return self._trial is not None and trial.number == self._trial.number

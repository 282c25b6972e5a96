"""Monitor of a study from its storage: whether it is over, and whether workers on other machines are alive."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Iterator

from optuna.trial import FrozenTrial

from armscan.errors import ArmscanError, StorageUnavailableError
from armscan.sweeps.scheduling.state import BEAT_S
from armscan.sweeps.storage.attribute_names import LEASE
from armscan.sweeps.study.phase import OpenedStudy
from armscan.sweeps.workers.heartbeat import LivenessCheck
from armscan.utils.retry import no_retry

POLL_S = 5.0
# A launcher that waits longer than this after the end of a study is waiting for a lost worker.
OVER_S = 20.0
# There is no heartbeat between two trials, nor while a worker starts.
LIFELESS_S = 120.0


class StudyMonitor:
    """Monitors a study."""

    def __init__(self, opened: OpenedStudy) -> None:
        self._opened = opened
        # One for each phase, because trial numbers repeat across phases.
        self._liveness: dict[str, LivenessCheck] = defaultdict(LivenessCheck)

    def is_over(self) -> bool:
        """Return whether no trial is running, and none is missing."""
        for phase in self._opened.phases:
            stopped = phase.scheduler.read_stop_request()
            state = phase.scheduler.state()
            if state.running or phase.scheduler.end_reason(state) is None:
                return False
            if stopped or phase.scheduler.failure_reason(state):
                return True
        return True

    def is_alive(self) -> bool:
        """Return whether the worker of any running trial is alive."""
        return any(True for _ in self._live_trials())

    def is_worked_on(self) -> bool:
        """Return whether a running trial has a live worker that has renewed its lease within `LIFELESS_S`."""
        now_s = time.time()
        beats_s = (trial.user_attrs.get(LEASE, {}).get(BEAT_S, 0.0) for trial in self._live_trials())
        return any(now_s - beat_s < LIFELESS_S for beat_s in beats_s)

    def _live_trials(self) -> Iterator[FrozenTrial]:
        """Yield the running trials whose workers are not dead."""
        for phase in self._opened.phases:
            for trial in phase.scheduler.state().running:
                if not self._liveness[phase.name].is_dead(trial):
                    yield trial

    def wait_until_over(self) -> bool:
        """Wait as long as any worker is alive; return whether the study is over then."""
        seen_s = time.monotonic()
        with no_retry():
            while time.monotonic() - seen_s < LIFELESS_S:
                try:
                    if self.is_over():
                        return True
                    is_alive = self.is_alive()
                except StorageUnavailableError:
                    # The workers wait for it, too.
                    is_alive = True
                if is_alive:
                    seen_s = time.monotonic()
                time.sleep(POLL_S)
        return False

    def wait_for_requeue(self) -> None:
        """Wait until the workers, which have been asked to leave, have requeued their trials."""
        with contextlib.suppress(ArmscanError), no_retry():
            while any(phase.scheduler.state().running for phase in self._opened.phases):
                time.sleep(1.0)

    @contextlib.contextmanager
    def interrupting(self) -> Iterator[None]:
        """Return a context to launch in, which interrupts a launcher that still waits when the study is over."""
        is_over, is_left = threading.Event(), threading.Event()

        def interrupt(*_: object) -> None:
            if not is_left.is_set():
                # No launcher catches this.
                raise KeyboardInterrupt

        def watch() -> None:
            over_s = 0.0
            with no_retry():
                while over_s < OVER_S:
                    if is_left.wait(POLL_S):
                        return
                    with contextlib.suppress(ArmscanError):
                        over_s = over_s + POLL_S if self.is_over() else 0.0
            is_over.set()
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)

        before = signal.signal(signal.SIGUSR1, interrupt)
        watching = threading.Thread(target=watch, daemon=True)
        watching.start()
        try:
            yield
        except KeyboardInterrupt:
            if not is_over.is_set():
                raise
        finally:
            is_left.set()
            watching.join()
            signal.signal(signal.SIGUSR1, before)

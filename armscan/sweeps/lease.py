"""Signs of life: a worker renews the lease of its trial, and takes over the trials of those who no longer do."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial, Trial

from armscan.log import say
from armscan.sweeps.ledger import Ledger
from armscan.sweeps.outcome import Notes, Outcome
from armscan.sweeps.tally import HOLDER, LEASE

BEAT_S, TICK_S = 10.0, 0.25
# Missed beats before a worker counts as dead: a busy storage may hold up some.
DEAD_AFTER_S = 40.0
# So many workers look after the others at each beat, and more of them take turns: a look costs the storage something
# for each trial that runs.
LOOKING_AT_ONCE = 64
# Of the time between two looks at a lease, in times of what it should be: in a longer one the storage was away for all,
# and nobody could renew any.
MOST_UNSEEN = 1.5
# Where the storage is away, what is at hand cannot be handed back: it is reclaimed, as its process is gone.
HAND_BACK_S = 5.0


def process_start(pid: int) -> str:
    """Returns when a process of this machine was started, as the system counts, so that its id is no other's.

    An empty text where there is no such process, or nothing but its exit code is left of it.
    """
    try:
        # The name before it, in brackets, may hold anything.
        state, *others = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return "" if state == "Z" else others[18]
    except (OSError, ValueError, IndexError):
        return ""


class LimitReachedError(Exception):
    """The study's time or environment steps are spent: what is at hand is not gone on with."""


class Witness:
    """Tells the dead from the living, by its own clock: clocks of machines differ."""

    def __init__(self) -> None:
        # Between two looks.
        self.pause_s = BEAT_S
        # By trial: its last sign, when it was last looked at, and for how long it has been the same by then.
        self._seen: dict[int, tuple[Any, float, float]] = {}
        self._host = socket.gethostname()

    def is_dead(self, trial: FrozenTrial) -> bool:
        """Whether the worker of a running trial is: its process is gone, or its lease has not been renewed for long."""
        lease = trial.user_attrs.get(LEASE, {})
        if lease.get("host") == self._host and Path("/proc/self/stat").exists():
            return process_start(lease["pid"]) != str(lease["started"])
        sign = lease.get("worker"), lease.get("beat")
        now_s = time.monotonic()
        before, looked_s, silent_s = self._seen.get(trial.number, (None, now_s, 0.0))
        silent_s = silent_s + min(now_s - looked_s, MOST_UNSEEN * self.pause_s) if before == sign else 0.0
        self._seen[trial.number] = sign, now_s, silent_s
        return silent_s > DEAD_AFTER_S


class Keeper:
    """Renews the lease of the trial that is at hand, looks after dead workers, and leaves when told to.

    Args:
        ledger: of the study.
        worker: what this worker is called.
        is_told_to_leave: asked several times a second.
        leave: called, mostly in another thread than the worker's, to end the process; what is at hand is handed back
            then.
        on_death: told of each trial whose worker had died.
        is_told_to_leave_soon: asked when a trial is claimed, and when it tells its progress: it loses nothing then.
    """

    def __init__(
        self,
        ledger: Ledger,
        worker: str,
        *,
        is_told_to_leave: Callable[[], bool],
        leave: Callable[[], None],
        on_death: Callable[[FrozenTrial], None],
        is_told_to_leave_soon: Callable[[], bool] = lambda: False,
    ) -> None:
        pid = os.getpid()
        self._lease: dict[str, Any] = {
            "worker": worker,
            "host": socket.gethostname(),
            "pid": pid,
            "started": process_start(pid),
            "beat": 0,
        }
        self._ledger, self._witness = ledger, Witness()
        self._is_told_to_leave, self._leave, self._on_death = is_told_to_leave, leave, on_death
        self._is_told_to_leave_soon = is_told_to_leave_soon
        self._trial: Trial | None = None
        self._close: Callable[[], None] | None = None
        # Of the trial at hand.
        self.notes = Notes()
        self._spent: str | None = None
        # When to look next.
        self._look_s = 0.0
        # Held while a trial changes hands, so that none is forgotten by who leaves in the middle of it.
        self._changing = threading.Lock()
        self._stopped = threading.Event()
        # Two, because signs of life wait for a storage that is away, and whoever is told to leave does not.
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._watch, self._beat)]

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Keeps watch as long as it lasts."""
        for thread in self._threads:
            thread.start()
        try:
            yield
        finally:
            self._stopped.set()
            for thread in self._threads:
                thread.join()

    def claim(self, outcome: Outcome | None = None, conclude: Callable[[], None] | None = None) -> Trial | None:
        """Takes a trial, as `Ledger.claim` does, and holds it from then on.

        Args:
            outcome: of the trial before, which is not held any more.
            conclude: what is then to be done of that one, also where the process is told to leave before it is.
        """
        with self._changing:
            # How far the trial before was is not said of this one.
            self._lease = {key: self._lease[key] for key in (*HOLDER, "beat")}
            self._trial = self._ledger.claim(self._lease, outcome)
            self._close, self.notes = conclude, Notes()
        self._leave_where_told_to()
        return self._trial

    def closing(self, close: Callable[[], None] | None) -> None:
        """Says how to close what the trial has open, where the process is told to leave."""
        self._close = close

    def tell_progress(self, figures: dict[str, Any]) -> None:
        """Notes how far the trial is, for the next renewal of the lease.

        Raises:
            LimitReachedError: if no trial is to be gone on with.
        """
        self._lease = self._lease | figures
        self._leave_where_told_to()
        if self._spent is not None:
            raise LimitReachedError(self._spent)

    def hand_back(self) -> None:
        """Leaves the trial, if one is held, for another to go on with."""
        with self._changing:
            if self._trial is not None:
                self._ledger.hand_back(self._trial, self._lease, self.notes)
                say(f"trial {self._trial.number} is handed back")
            if self._close is not None:
                self._close()
            self._trial = self._close = None

    def _leave_where_told_to(self) -> None:
        if self._is_told_to_leave_soon():
            self.hand_back()
            self._leave()

    def _watch(self) -> None:
        while not self._stopped.wait(TICK_S):
            if self._is_told_to_leave():
                late = threading.Timer(HAND_BACK_S, self._leave)
                late.daemon = True
                late.start()
                try:
                    self.hand_back()
                finally:
                    late.cancel()
                    self._leave()

    def _beat(self) -> None:
        while True:
            try:
                self._give_sign()
            # Whatever a storage raises that is away for long: the next beat may find it there again.
            except Exception as error:
                say(f"no sign of life could be given: {error!r}")
            if self._stopped.wait(BEAT_S):
                return

    def _give_sign(self) -> None:
        with self._changing:
            self._lease = self._lease | {"beat": self._lease["beat"] + 1}
            is_looking = time.monotonic() >= self._look_s
            tally = self._ledger.renew(self._trial, self._lease, is_looking=is_looking)
        if tally is None:
            return
        self._witness.pause_s = BEAT_S * max(1.0, len(tally.running) / LOOKING_AT_ONCE)
        # A beat is never quite as long as it should be.
        self._look_s = time.monotonic() + self._witness.pause_s - BEAT_S / 2
        for trial in self._ledger.reclaim(self._witness.is_dead, tally):
            self._on_death(trial)
        self._spent = self._ledger.spent(tally)

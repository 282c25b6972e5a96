"""How a study is getting on whose workers are out of sight, from what stands in its storage."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Iterator

from armscan.errors import StorageAwayError
from armscan.patience import impatient
from armscan.sweeps.judging import lacking
from armscan.sweeps.lease import Witness
from armscan.sweeps.opening import OpenStudy

LOOK_S = 5.0
# A launcher that waits for longer after the end of a study waits for a worker that nobody will hear of any more.
OVER_S = 20.0
# Between two trials nobody shows signs of life, nor while a worker starts.
LIFELESS_S = 120.0


class Vigil:
    """Watches over a study.

    Args:
        opened: the study.
    """

    def __init__(self, opened: OpenStudy) -> None:
        self._opened = opened
        # One for each phase: trials of both have the same numbers.
        self._witnesses: dict[str, Witness] = defaultdict(Witness)

    def is_over(self) -> bool:
        """Whether nobody is at work, and nothing is left to be done."""
        searching, *judging = self._opened.begun()
        for phase in (searching, *judging):
            tally = phase.ledger.tally()
            if tally.running or phase.ledger.end(tally) is None:
                return False
        if searching.ledger.broken(searching.ledger.tally()):
            return True
        judged = judging[0].ledger.study if judging else None
        return not lacking(self._opened.settings, searching.ledger.study, judged)

    def is_alive(self) -> bool:
        """Whether the worker of any trial is."""
        return any(
            not self._witnesses[phase.name].is_dead(trial)
            for phase in self._opened.begun()
            for trial in phase.ledger.tally().running
        )

    def outlast(self) -> bool:
        """Waits as long as anybody is at work; returns whether the study is over then."""
        seen_s = time.monotonic()
        with impatient():
            while time.monotonic() - seen_s < LIFELESS_S:
                try:
                    if self.is_over():
                        return True
                    is_alive = self.is_alive()
                except StorageAwayError:
                    # Everybody waits for it.
                    is_alive = True
                if is_alive:
                    seen_s = time.monotonic()
                time.sleep(LOOK_S)
        return False

    def see_off(self) -> None:
        """Waits until the workers, who have been asked to leave, have handed back what they ran."""
        with contextlib.suppress(StorageAwayError), impatient():
            while any(phase.ledger.tally().running for phase in self._opened.begun()):
                time.sleep(1.0)

    @contextlib.contextmanager
    def interrupting(self) -> Iterator[None]:
        """What launching is done in by a launcher that may wait on when the study is over: then it is interrupted."""
        is_over, is_left = threading.Event(), threading.Event()

        def interrupt(*_: object) -> None:
            if not is_left.is_set():
                # What every launcher lets through.
                raise KeyboardInterrupt

        def watch() -> None:
            with impatient():
                if self._seen_over(is_left):
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

    def _seen_over(self, is_left: threading.Event) -> bool:
        """Returns whether the study has been over for a while; not where the launcher has come back before."""
        over_s = 0.0
        while over_s < OVER_S:
            if is_left.wait(LOOK_S):
                return False
            with contextlib.suppress(StorageAwayError):
                over_s = over_s + LOOK_S if self.is_over() else 0.0
        return True

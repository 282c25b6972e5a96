"""The workers of a study: launched, waited for wherever they are, and none of them left at the end."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path

from armscan.errors import ArmscanError, AwayError, StorageAwayError, StudyError
from armscan.launchers import LAUNCHER, ON_THIS_MACHINE, quieten_launcher
from armscan.mistakes import mistake_in_one_line
from armscan.patience import impatient
from armscan.settings import TRACKING_URI
from armscan.sweeps.clearing import close_orphans, close_runs_of
from armscan.sweeps.command_line import STORAGE, USUAL_LAUNCHER, WORKER_KEY, CommandLine, fixed_by
from armscan.sweeps.lease import Witness, process_start
from armscan.sweeps.opening import OpenStudy
from armscan.sweeps.screen import Screen
from armscan.sweeps.supervising import LAUNCHER_FILE, STOP_FILE, WORKER_FILES, Process, here, keep_gpus, local_workers
from armscan.sweeps.values import written
from armscan.sweeps.vigil import Vigil
from armscan.tracking import TrackedRun, sync
from armscan.tracking.run import SHORT_WAIT_S

# Workers that are asked to leave have so long, before their launcher is interrupted and those on this machine are
# killed; a folder that is shared shows others only after a while that they are asked.
LEAVE_S, LEAVE_ELSEWHERE_S = 4.0, 20.0
# A study's own budgets say when it ends; ten years.
MINUTES_WITHOUT_END = 5_256_000
MAX_REASON_CHARS = 500
Launch = Callable[[Sequence[str]], object]


def run_workers(opened: OpenStudy, given: CommandLine, launcher: str, launch: Launch) -> None:
    """Has the workers of a study launched, and waits for their end.

    Args:
        opened: the study.
        given: what it was asked for with.
        launcher: the choice of `hydra/launcher`.
        launch: runs the command with Hydra, with the words it is given.

    Raises:
        KeyboardInterrupt: if somebody has ended it; the workers have been asked to leave.
        StudyError: if the launcher has failed, and nobody is at work.
    """
    started = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{socket.gethostname()}_{os.getpid()}"
    folder = here() / opened.folder / "workers" / started
    folder.mkdir(parents=True)
    Process.current().write(folder / LAUNCHER_FILE)
    words = _words(opened, given, launcher, folder)
    tracked = TrackedRun.joined(opened.client, opened.run_id, name=opened.settings.name, folder=folder)
    tracked.set_status("RUNNING")
    leave_s = LEAVE_S if launcher in ON_THIS_MACHINE else LEAVE_ELSEWHERE_S
    with _leaving(opened, folder, tracked, leave_s), Screen(opened, folder):
        if launcher not in ON_THIS_MACHINE:
            _launch_elsewhere(opened, folder, launcher, lambda: launch(words))
        elif launcher == USUAL_LAUNCHER:
            keep_gpus()
            with _interrupted_alone():
                launch(words)
        else:
            launch(words)


def _words(opened: OpenStudy, given: CommandLine, launcher: str, folder: Path) -> list[str]:
    """Returns the words that the workers are launched with."""
    n_workers = opened.settings.workers
    words = ["-m", *given.launching, *_addresses(opened, given)]
    words += [f"{WORKER_KEY}={','.join(map(str, range(n_workers)))}", f"hydra.sweep.dir={written(str(folder))}"]
    if launcher == USUAL_LAUNCHER:
        # Before the others, which may say something else.
        words.insert(1, f"hydra.launcher.timeout_min={MINUTES_WITHOUT_END}")
    if launcher == "joblib":
        words.append(f"hydra.launcher.n_jobs={n_workers}")
    return words


def _addresses(opened: OpenStudy, given: CommandLine) -> list[str]:
    """Returns the words that say where all is kept, where that stands in the environment, which others have not."""
    told, kept = fixed_by(given.words), {STORAGE: opened.settings.storage, TRACKING_URI: opened.config.tracking.uri}
    return [f"{key}={written(uri)}" for key, uri in kept.items() if key not in told]


def _launch_elsewhere(opened: OpenStudy, folder: Path, launcher: str, launch: Callable[[], object]) -> None:
    """Launches workers that this machine does not see, and waits for the end of the study, with the launcher or not."""
    vigil = Vigil(opened)
    quieten_launcher(launcher)
    try:
        with vigil.interrupting():
            launch()
    except SystemExit:
        # What Ray has put in the place of our answer to SIGTERM.
        signal.raise_signal(signal.SIGINT)
        vigil.see_off()
    # What a worker's machine has said, after all of them have ended.
    except ArmscanError as error:
        print(f"error: {error}", file=sys.stderr)
    # Whatever a launcher raises: for one job that was cancelled, too, while all others go on.
    except Exception as error:
        line = mistake_in_one_line(error) or " ".join(str(error).split()) or repr(error)
        failed = StudyError(f"{LAUNCHER} is {launcher!r}, which has failed: {line[:MAX_REASON_CHARS]}")
        if not any(folder.glob(WORKER_FILES)):
            raise failed from error
        print(f"{failed}; waiting for workers that are still there", file=sys.stderr)
        if not vigil.outlast():
            raise failed from error


@contextlib.contextmanager
def _leaving(opened: OpenStudy, folder: Path, tracked: TrackedRun, leave_s: float) -> Iterator[None]:
    """What the workers are launched in: on the way out none of them is left, and nothing that they ran is open."""
    status, is_asked = "FINISHED", threading.Event()
    patience = threading.Timer(leave_s, os.kill, (os.getpid(), signal.SIGINT))
    patience.daemon = True

    def ask(*_: object) -> None:
        """Asks the workers to leave; a launcher that is interrupted itself may kill them before they could."""
        if is_asked.is_set():
            raise KeyboardInterrupt
        is_asked.set()
        (folder / STOP_FILE).touch()
        patience.start()

    asking = [signal.SIGINT, signal.SIGTERM]
    # Its terminal was closed; where `nohup` has it go on, it does.
    asking += [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN else []
    before = {each: signal.signal(each, ask) for each in asking}
    try:
        yield
    except BaseException:
        status = "KILLED"
        raise
    finally:
        patience.cancel()
        for each in before:
            signal.signal(each, signal.SIG_IGN)
        (folder / STOP_FILE).touch()
        _end_workers(folder)
        # Where the storage is away, whoever goes on with the study does it.
        with contextlib.suppress(StorageAwayError), impatient():
            for phase in opened.begun():
                for trial in phase.ledger.reclaim(Witness().is_dead):
                    close_runs_of(trial, phase)
        _deliver(opened, tracked, "KILLED" if is_asked.is_set() else status)
        for each, handler in before.items():
            signal.signal(each, handler)
    if is_asked.is_set():
        raise KeyboardInterrupt


def _deliver(opened: OpenStudy, tracked: TrackedRun, status: str) -> None:
    """Ends the study's own run, and delivers what the runs of its trials have left because their store was away."""
    is_there = tracked.end(status, wait_s=SHORT_WAIT_S if status == "KILLED" else None)
    left = []
    if is_there:
        left = [each.folder for each in sync(opened.folder, lambda _: opened.client) if each.left]
        with contextlib.suppress(AwayError), impatient():
            for phase in opened.begun():
                close_orphans(phase)
    if not is_there or left:
        print(f"not all is tracked: python -m armscan.track sync {opened.folder} delivers the rest", file=sys.stderr)


@contextlib.contextmanager
def _interrupted_alone() -> Iterator[None]:
    """What launching is done in by a launcher whose processes would tell a Ctrl-C, each with a trace.

    They inherit that this thread does not take it. Another thread of this process does, and then this one is told as
    usual, as soon as it has slept its second.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_workers(folder: Path) -> None:
    """Waits for the workers on this machine to leave, and kills those that do not."""
    until_s = time.monotonic() + LEAVE_S
    while (alive := local_workers(folder)) and time.monotonic() < until_s:
        time.sleep(0.05)
    for worker in alive:
        if process_start(worker.pid) == worker.started:
            os.kill(worker.pid, signal.SIGKILL)

"""`python -m armscan.run -m sweeps=NAME`: a study is checked, its workers launched and watched, its result told."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from datetime import datetime
from pathlib import Path

from armscan.errors import AwayError, StorageAwayError
from armscan.mistakes import quieten_libraries
from armscan.passwords import check_written
from armscan.patience import impatient
from armscan.settings import TRACKING_URI, plain
from armscan.sweeps.attempt import composed
from armscan.sweeps.checking import check_space
from armscan.sweeps.clearing import close_orphans, close_runs_of
from armscan.sweeps.command_line import LAUNCHER, STORAGE, USUAL_LAUNCHER, WORKER_KEY, CommandLine
from armscan.sweeps.lease import Witness, process_start
from armscan.sweeps.opening import OpenStudy, open_for_work, read_settings
from armscan.sweeps.planning import print_plan
from armscan.sweeps.screen import Screen, print_result
from armscan.sweeps.study import existing_study
from armscan.sweeps.supervising import LAUNCHER_FILE, STOP_FILE, Process, keep_gpus, local_workers
from armscan.tracking import TrackedRun, sync
from armscan.tracking.run import SHORT_WAIT_S

LAUNCHERS_ON_THIS_MACHINE = ("basic", "joblib", "submitit_local")
LEAVE_S = 4.0
# A study's own budgets say when it ends; ten years.
MINUTES_WITHOUT_END = 5_256_000


def run_study(words: Sequence[str], launch: Callable[[Sequence[str]], object]) -> int:
    """Runs a study, or shows what it would run.

    Args:
        words: of the command line.
        launch: runs the command with Hydra, with the words it is given.

    Returns:
        The exit code: 0 where there is a result, 1 where too many trials failed.

    Raises:
        InvalidValueError: if the words are not allowed.
        StudyError: see `open_for_work`.
        TrackingError: likewise.
    """
    given = CommandLine.read(words)
    quieten_libraries()
    settings, task, config = read_settings(given.of_trials)
    for key, uri in ((STORAGE, settings.storage), (TRACKING_URI, config.tracking.uri)):
        check_written(key, uri)
    given = given.with_services({STORAGE: settings.storage, TRACKING_URI: config.tracking.uri})
    launcher = composed(given.launching)[1][LAUNCHER]
    if launcher in LAUNCHERS_ON_THIS_MACHINE:
        settings.check_workers(len(os.sched_getaffinity(0)))
    check_space(settings, task, given.of_trials, config)
    # Before anything is made: a study or a storage that would be refused.
    existing = existing_study(settings, plain(config))
    if given.is_plan or settings.plan:
        print_plan(settings, existing)
        return 0
    opened = open_for_work(settings, task, config, given.of_trials)
    for phase in opened.begun():
        if n_failed := phase.ledger.forgive():
            print(f"{phase.name}: {n_failed} trials have failed before, which count no more from now on")
    return _launched(opened, given, launcher, launch)


def _launched(opened: OpenStudy, given: CommandLine, launcher: str, launch: Callable[[Sequence[str]], object]) -> int:
    """Has the workers of a study launched, watches them to their end, and tells the result; returns the exit code."""
    folder = opened.folder / "workers" / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{socket.gethostname()}_{os.getpid()}"
    folder.mkdir(parents=True)
    Process.current().write(folder / LAUNCHER_FILE)
    n_workers = opened.settings.workers
    numbers = ",".join(map(str, range(n_workers)))
    started = ["-m", *given.launching, f"{WORKER_KEY}={numbers}", f"hydra.sweep.dir={folder}"]
    waiting: AbstractContextManager[None] = contextlib.nullcontext()
    if launcher == "joblib":
        started.append(f"hydra.launcher.n_jobs={n_workers}")
    tracked = TrackedRun.joined(opened.client, opened.run_id, name=opened.settings.name, folder=folder)
    tracked.set_status("RUNNING")
    if launcher == USUAL_LAUNCHER:
        started.insert(1, f"hydra.launcher.timeout_min={MINUTES_WITHOUT_END}")
        waiting = _interrupted_alone()
        keep_gpus()
    try:
        with _leaving(opened, folder, tracked), Screen(opened, folder), waiting:
            launch(started)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on with the study", file=sys.stderr)
        return 130
    return print_result(opened)


@contextlib.contextmanager
def _leaving(opened: OpenStudy, folder: Path, tracked: TrackedRun) -> Iterator[None]:
    """What the workers are launched in: on the way out none of them is left, and nothing that they ran is open."""
    status, is_asked = "FINISHED", threading.Event()
    patience = threading.Timer(LEAVE_S, os.kill, (os.getpid(), signal.SIGINT))
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

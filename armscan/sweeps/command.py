"""`python -m armscan.run -m sweeps=NAME`: a study is checked, its workers launched and watched, its result told."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from armscan.errors import InvalidValueError, StorageAwayError
from armscan.mistakes import quieten_libraries
from armscan.settings import MULTIRUN
from armscan.sweeps.checking import check_space
from armscan.sweeps.database import hand_over_password
from armscan.sweeps.lease import Witness, process_start
from armscan.sweeps.opening import OpenStudy, open_for_work, read_settings
from armscan.sweeps.patience import impatient
from armscan.sweeps.planning import print_plan
from armscan.sweeps.screen import Screen, print_result
from armscan.sweeps.storage import without_password
from armscan.sweeps.supervising import LAUNCHER_FILE, STOP_FILE, Process, local_workers, supervise

WORKER_KEY, SEARCH_PATH, STORAGE = "study.worker", "hydra.searchpath", "study.storage="
PLAN = "--plan"
LAUNCHERS_ON_THIS_MACHINE = ("basic", "joblib", "submitit_local")
LEAVE_S = 4.0


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
    own = [word for word in words if word not in (*MULTIRUN, PLAN)]
    if len(own) == len(words) or not set(words) & {*MULTIRUN}:
        raise InvalidValueError("a study has many runs, which needs -m: python -m armscan.run -m " + " ".join(own))
    _check_single_values(own)
    quieten_libraries()
    of_study = _words_of_study(own)
    settings, task, config = read_settings(of_study)
    # Words are written into files, logs and the tracking store.
    if (shown := without_password(settings.storage)) != settings.storage:
        hand_over_password(settings.storage)
        own = [*(word for word in own if not word.lstrip("+").startswith(STORAGE)), f"{STORAGE}'{shown}'"]
        of_study = _words_of_study(own)
    check_space(settings, task, of_study, config)
    if PLAN in words or settings.plan:
        print_plan(settings)
        return 0
    launcher = _launcher(own)
    if launcher in LAUNCHERS_ON_THIS_MACHINE:
        settings.check_workers(len(os.sched_getaffinity(0)))
    opened = open_for_work(of_study)
    folder = opened.folder / "workers" / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{socket.gethostname()}_{os.getpid()}"
    folder.mkdir(parents=True)
    Process.current().write(folder / LAUNCHER_FILE)
    numbers = ",".join(map(str, range(settings.workers)))
    started = ["-m", *own, f"{WORKER_KEY}={numbers}", f"hydra.sweep.dir={folder}"]
    if launcher == "joblib":
        started.append(f"hydra.launcher.n_jobs={settings.workers}")
    opened.client.update_run(opened.run_id, status="RUNNING")
    with _leaving(opened, folder), Screen(opened, folder):
        launch(started)
    return print_result(opened)


def run_worker(config: DictConfig, words: Sequence[str], folder: Path) -> None:
    """What a launcher runs: one worker, and others in its place where it dies.

    Args:
        config: with the number of the worker.
        words: of the worker's job.
        folder: of the workers of this start.
    """
    supervise(_words_of_study(words), int(config.study.worker), folder)


def _words_of_study(words: Sequence[str]) -> list[str]:
    """Returns the words that the configuration of a trial is composed of.

    Those of Hydra itself are for the launching of workers, but for the one that says where configurations are found.
    """
    others = ("hydra", f"{WORKER_KEY}=")
    return [word for word in words if not word.lstrip("+~").startswith(others) or word.startswith(SEARCH_PATH)]


@contextlib.contextmanager
def _leaving(opened: OpenStudy, folder: Path) -> Iterator[None]:
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

    before = {each: signal.signal(each, ask) for each in (signal.SIGINT, signal.SIGTERM)}
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
            opened.searching().ledger.reclaim(Witness().is_dead)
        opened.client.set_terminated(opened.run_id, "KILLED" if is_asked.is_set() else status)
        for each, handler in before.items():
            signal.signal(each, handler)
    if is_asked.is_set():
        raise KeyboardInterrupt


def _end_workers(folder: Path) -> None:
    """Waits for the workers on this machine to leave, and kills those that do not."""
    until_s = time.monotonic() + LEAVE_S
    while (alive := local_workers(folder)) and time.monotonic() < until_s:
        time.sleep(0.05)
    for worker in alive:
        if process_start(worker.pid) == worker.started:
            os.kill(worker.pid, signal.SIGKILL)


def _check_single_values(words: Sequence[str]) -> None:
    for override in OverridesParser.create().parse_overrides(list(words)):
        if override.is_sweep_override():
            raise InvalidValueError(
                f"{override.input_line!r} gives several values, but those of a study come from its space: give "
                f"'+study.space.{override.key_or_group}.choices=[...]'"
            )


def _launcher(words: Sequence[str]) -> str:
    chosen: Any = [word.partition("=")[2] for word in words if word.startswith("hydra/launcher=")]
    return str(chosen[-1]) if chosen else "joblib"

"""A worker's process, and the one above it, which starts another in its place when it dies.

The one above does nothing else, so that nothing is imported here that takes long, such as torch and MLflow.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO, Self

from omegaconf import DictConfig

from armscan.errors import AwayError, StudyError
from armscan.files import write_whole
from armscan.sweeps.command_line import words_of_trials
from armscan.sweeps.lease import process_start
from armscan.sweeps.slurm import SOON, Notice

LAUNCHER_FILE, STOP_FILE, WORKER_FILES = "launcher.json", "stop", "worker-*.json"
# The exit codes of a worker that was told to leave, of one whose storage was away for too long, and of all that have
# ended by themselves and are not started again.
LEFT, AWAY = 130, 75
ENDS = (0, LEFT, AWAY)
GPUS, KEPT_GPUS, ALL_GPUS = "CUDA_VISIBLE_DEVICES", "ARMSCAN_GPUS", "all"
# A worker that dies again and again does no work; its trials have long been given up by then.
MAX_RESTARTS = 100
# One that was not killed, but has crashed, will crash again.
MAX_ERRORS = 5
# A worker that is told to leave soon has so long for its epoch.
SOON_S = 60.0
WORKER_PROGRAM = """
try:
    from armscan.sweeps.supervising import worker_main
    worker_main()
except KeyboardInterrupt:
    raise SystemExit(130)
"""


@dataclass(frozen=True)
class Process:
    """A process, for others to know whether it is still there.

    Args:
        host: that it runs on.
        pid: its process.
        started: see `process_start`.
        directory: that it works in.
    """

    host: str
    pid: int
    started: str
    directory: str

    @classmethod
    def current(cls) -> Self:
        """This process."""
        return cls(socket.gethostname(), os.getpid(), process_start(os.getpid()), str(here()))

    @classmethod
    def read(cls, file: Path) -> Self:
        """Returns the one that has left word of itself in a file."""
        return cls(**json.loads(file.read_text()))

    def write(self, file: Path) -> None:
        """Leaves word of it."""
        write_whole(file, lambda opened: opened.write(json.dumps(asdict(self)).encode()))

    @property
    def is_gone(self) -> bool:
        """Whether it has ended, as far as can be seen from here: not from another machine."""
        is_here = self.host == socket.gethostname() and self.started != ""
        return is_here and process_start(self.pid) != self.started


def here() -> Path:
    """Returns the directory of this process as its user calls it.

    That is a name which other machines know; what a link or a mount of this machine leads to may not be.
    """
    called = Path(os.environ.get("PWD", ""))
    return called if called.is_absolute() and called.is_dir() and called.samefile(".") else Path.cwd()


def local_workers(folder: Path) -> list[Process]:
    """Returns the workers of a start that are at work on this machine."""
    workers = [Process.read(file) for file in folder.glob(WORKER_FILES)]
    host = socket.gethostname()
    return [each for each in workers if each.host == host and process_start(each.pid) == each.started]


def run_worker(config: DictConfig, words: Sequence[str], folder: Path) -> None:
    """What a launcher runs: one worker, and others in its place where it dies.

    Args:
        config: with the number of the worker.
        words: of the worker's job.
        folder: of the workers of this start.
    """
    supervise(words_of_trials(words), int(config.study.worker), folder)


def supervise(words: Sequence[str], number: int, folder: Path) -> None:
    """Runs a worker, and another in its place when it is killed, until one ends by itself.

    Args:
        words: of the study.
        number: of the worker.
        folder: of the workers of one start; each writes its log there.

    Raises:
        StudyError: if this machine does not see what the one of the launcher does.
        SystemExit: see `Notice.follow`.
    """
    launcher = _launcher_of(folder)
    if os.getpid() != launcher.pid:
        # A Ctrl-C reaches all processes of a terminal, but it is the launcher that asks the workers to leave.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    handed_over = pickle.dumps((list(words), number, str(folder)))
    n_errors = 0
    with Notice.taken() as notice, (folder / f"worker-{number}.log").open("ab") as log:
        for _ in range(MAX_RESTARTS):
            if launcher.is_gone or (folder / STOP_FILE).exists():
                return
            code = _worked(handed_over, launcher.directory, log, notice)
            if notice.is_given and code not in (0, AWAY):
                notice.follow()
                return
            if code in ENDS:
                return
            n_errors += code > 0
            if n_errors == MAX_ERRORS:
                return


def _launcher_of(folder: Path) -> Process:
    """Returns the process that launched this start, where this machine sees what that one does."""
    file = folder / LAUNCHER_FILE
    if not file.exists():
        raise _not_seen(folder)
    launcher = Process.read(file)
    if not Path(launcher.directory).is_dir():
        raise _not_seen(Path(launcher.directory))
    return launcher


def _not_seen(folder: Path) -> StudyError:
    return StudyError(
        f"{folder} of the machine that the study was started on is not seen by {socket.gethostname()}: all machines "
        "with workers must share it"
    )


def _worked(handed_over: bytes, directory: str, log: BinaryIO, notice: Notice) -> int:
    """Runs the process of a worker to its end; returns its exit code."""
    with subprocess.Popen(
        [sys.executable, "-c", WORKER_PROGRAM],
        stdin=subprocess.PIPE,
        cwd=directory,
        env=_environment(),
        stdout=log,
        stderr=log,
        start_new_session=True,
    ) as worker:
        notice.pass_on_to(worker)
        worker.communicate(handed_over)
        return worker.returncode


def keep_gpus() -> None:
    """Notes which GPUs this process may use, for workers whose launcher would hide them."""
    os.environ[KEPT_GPUS] = os.environ.get(GPUS, ALL_GPUS)


def _environment() -> dict[str, str]:
    environment = dict(os.environ)
    kept = environment.pop(KEPT_GPUS, None)
    if kept == ALL_GPUS:
        environment.pop(GPUS, None)
    elif kept is not None:
        environment[GPUS] = kept
    return environment


def worker_main() -> None:
    """The process of a worker, which is told on standard input what to work at."""
    words, number, folder_name = pickle.load(sys.stdin.buffer)
    folder, parent_pid = Path(folder_name), os.getppid()
    Process.current().write(folder / f"worker-{number}.json")
    launcher, is_asked, is_asked_soon = Process.read(folder / LAUNCHER_FILE), threading.Event(), threading.Event()
    late = threading.Timer(SOON_S, is_asked.set)
    late.daemon = True

    def ask_soon(*_: object) -> None:
        # It may be told by Slurm, and again by the process above.
        if not is_asked_soon.is_set():
            is_asked_soon.set()
            late.start()

    for asking in (signal.SIGINT, signal.SIGTERM):
        signal.signal(asking, lambda *_: is_asked.set())
    signal.signal(SOON, ask_soon)
    # Whatever the launcher has kept from its processes.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def is_told_to_leave() -> bool:
        is_alone = os.getppid() != parent_pid or launcher.is_gone
        return is_asked.is_set() or is_alone or (folder / STOP_FILE).exists()

    from armscan.log import say
    from armscan.services import hand_over_local
    from armscan.sweeps.working import work

    try:
        # For launchers that do not pass the environment on.
        hand_over_local()
        work(
            words,
            f"{folder.name}/{number}",
            is_told_to_leave,
            is_told_to_leave_soon=is_asked_soon.is_set,
            leave=lambda: os._exit(LEFT),
        )
    except AwayError as error:
        say(str(error))
        raise SystemExit(AWAY) from error

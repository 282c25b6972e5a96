"""The process of a worker, and its supervisor, which restarts it when it is killed.

The supervisor does nothing else: nothing slow to import, such as torch and MLflow, is imported here.
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

from armscan.config.sources import working_folder
from armscan.errors import AwayError, StudyError
from armscan.sweeps.study.arguments import words_of_trials
from armscan.sweeps.workers.slurm import SOON, Notice
from armscan.utils.files import atomic_write
from armscan.utils.processes import ParentProcess, process_start

LAUNCHER_FILE, STOP_FILE, WORKER_FILES = "launcher.json", "stop", "worker-*.json"
# Exit codes of a worker that was told to leave, of one whose storage was away for too long, and of all that are not
# restarted.
LEFT, AWAY = 130, 75
ENDS = (0, LEFT, AWAY)
GPUS, KEPT_GPUS, ALL_GPUS = "CUDA_VISIBLE_DEVICES", "ARMSCAN_GPUS", "all"
# A worker that is killed again and again does no work; its trials have failed long before.
MAX_RESTARTS = 100
# One that crashes, and is not killed, will crash again.
MAX_ERRORS = 5
# Time that a worker has for its current epoch when it is told to leave soon.
SOON_S = 60.0
WORKER_PROGRAM = """
try:
    from armscan.sweeps.workers.supervisor import worker_main
    worker_main()
except KeyboardInterrupt:
    raise SystemExit(130)
"""


@dataclass(frozen=True)
class ProcessInfo:
    """A process, so that others can tell whether it is still alive.

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
        """Return the current process."""
        return cls(socket.gethostname(), os.getpid(), process_start(os.getpid()), str(working_folder()))

    @classmethod
    def read(cls, file: Path) -> Self:
        """Return the process that a file describes."""
        return cls(**json.loads(file.read_text()))

    def write(self, file: Path) -> None:
        """Write it to a file."""
        atomic_write(file, lambda opened: opened.write(json.dumps(asdict(self)).encode()))

    @property
    def is_gone(self) -> bool:
        """Whether it is known to have ended; never known of a process on another machine."""
        is_here = self.host == socket.gethostname() and self.started != ""
        return is_here and process_start(self.pid) != self.started


def local_workers(folder: Path) -> list[ProcessInfo]:
    """Return the workers of a start that are alive on this machine."""
    workers = [ProcessInfo.read(file) for file in folder.glob(WORKER_FILES)]
    host = socket.gethostname()
    return [each for each in workers if each.host == host and process_start(each.pid) == each.started]


def run_worker(config: DictConfig, words: Sequence[str], folder: Path) -> None:
    """Run one job of a launcher: a worker, restarted when it is killed.

    Args:
        config: with the number of the worker.
        words: of the worker's job.
        folder: of the workers of this start.
    """
    supervise(words_of_trials(words), int(config.study.worker), folder)


def supervise(words: Sequence[str], number: int, folder: Path) -> None:
    """Run a worker, and restart it when it is killed, until it ends by itself.

    Args:
        words: of the study.
        number: of the worker.
        folder: of the workers of one start; each writes its log there.

    Raises:
        StudyError: if this machine does not see the folders of the launcher's.
        SystemExit: see `Notice.follow`.
    """
    launcher = _launcher_of(folder)
    if os.getpid() != launcher.pid:
        # A Ctrl-C reaches all processes of a terminal, but it is the launcher that asks the workers to leave.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    study_input = pickle.dumps((list(words), number, str(folder)))
    n_errors = 0
    with Notice.taken() as notice, (folder / f"worker-{number}.log").open("ab") as log_file:
        for _ in range(MAX_RESTARTS):
            if launcher.is_gone or (folder / STOP_FILE).exists():
                return
            code = _worked(study_input, launcher.directory, log_file, notice)
            if notice.is_given and code not in (0, AWAY):
                notice.follow()
                return
            if code in ENDS:
                return
            n_errors += code > 0
            if n_errors == MAX_ERRORS:
                return


def _launcher_of(folder: Path) -> ProcessInfo:
    """Return the process that launched this start; raises if this machine does not see its folders."""
    file = folder / LAUNCHER_FILE
    if not file.exists():
        raise _not_seen(folder)
    launcher = ProcessInfo.read(file)
    if not Path(launcher.directory).is_dir():
        raise _not_seen(Path(launcher.directory))
    return launcher


def _not_seen(folder: Path) -> StudyError:
    return StudyError(
        f"{folder} of the machine that the study was started on is not seen by {socket.gethostname()}: all machines "
        "with workers must share it"
    )


def _worked(study_input: bytes, directory: str, log_file: BinaryIO, notice: Notice) -> int:
    """Run the process of a worker to its end; returns its exit code."""
    with subprocess.Popen(
        [sys.executable, "-c", WORKER_PROGRAM],
        stdin=subprocess.PIPE,
        cwd=directory,
        env=_environment(),
        stdout=log_file,
        stderr=log_file,
        start_new_session=True,
    ) as worker:
        notice.pass_on_to(worker)
        worker.communicate(study_input)
        return worker.returncode


def keep_gpus() -> None:
    """Keep which GPUs this process may use, for workers whose launcher would hide them."""
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
    """Run the process of a worker, which reads its study from standard input."""
    words, number, folder_name = pickle.load(sys.stdin.buffer)
    folder, parent = Path(folder_name), ParentProcess()
    ProcessInfo.current().write(folder / f"worker-{number}.json")
    launcher, is_asked, is_asked_soon = ProcessInfo.read(folder / LAUNCHER_FILE), threading.Event(), threading.Event()
    late = threading.Timer(SOON_S, is_asked.set)
    late.daemon = True

    def ask_soon(*_: object) -> None:
        # Slurm may signal it, and the supervisor again.
        if not is_asked_soon.is_set():
            is_asked_soon.set()
            late.start()

    for asking in (signal.SIGINT, signal.SIGTERM):
        signal.signal(asking, lambda *_: is_asked.set())
    signal.signal(SOON, ask_soon)
    # The launcher may have blocked it.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def is_told_to_leave() -> bool:
        is_alone = parent.is_gone or launcher.is_gone
        return is_asked.is_set() or is_alone or (folder / STOP_FILE).exists()

    from armscan.sweeps.workers.worker import work
    from armscan.utils.log import log

    try:
        work(
            words,
            f"{folder.name}/{number}",
            is_told_to_leave,
            is_told_to_leave_soon=is_asked_soon.is_set,
            leave=lambda: os._exit(LEFT),
        )
    except AwayError as error:
        log(str(error))
        raise SystemExit(AWAY) from error

"""The process of a worker, and its supervisor, which restarts it when it is killed.

The supervisor does nothing else, so nothing slow to import, such as torch and MLflow, is imported here.
"""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import BinaryIO

from armscan.errors import ArmscanError, ServiceUnavailableError, StudyError
from armscan.sweeps.workers.leave_request import LeaveRequest
from armscan.sweeps.workers.slurm import NOW, SOON, SlurmSignals
from armscan.utils.log import log
from armscan.utils.processes import EXIT_INTERRUPTED, ProcessInfo, child_command, on_parent_exit

LAUNCHER_FILE, STOP_FILE, WORKER_FILES = "launcher.json", "stop", "worker-*.json"
# Exit codes of a worker whose storage or tracking store was unavailable for too long, of one that cannot work on the
# study as it is stored, and of all that are not restarted: those that were told to leave, too.
UNAVAILABLE, REFUSED = 75, 65
ENDS = (0, EXIT_INTERRUPTED, UNAVAILABLE, REFUSED)
GPUS, KEPT_GPUS, ALL_GPUS = "CUDA_VISIBLE_DEVICES", "ARMSCAN_GPUS", "all"
# A worker that is killed again and again does no work; by then its trials have failed.
MAX_RESTARTS = 100
# One that crashes, and is not killed, will crash again.
MAX_ERRORS = 5


def local_workers(folder: Path) -> list[ProcessInfo]:
    """Return the workers of a start that are alive on this machine, and visible to this process."""
    workers = [ProcessInfo.read(file) for file in folder.glob(WORKER_FILES)]
    return [each for each in workers if each.is_here and each.is_alive]


def run_worker(overrides: Sequence[str], number: int, folder: Path) -> None:
    """Run one job of a launcher: a worker, restarted when it is killed, until it ends by itself."""
    launcher = _launcher_of(folder)
    if not launcher.is_current:
        # A Ctrl-C reaches all processes of a terminal, but it is the launcher that asks the workers to leave.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    study_input = pickle.dumps((list(overrides), number, folder))
    n_errors = 0
    with SlurmSignals.handled() as signals, (folder / f"worker-{number}.log").open("ab") as log_file:
        for _ in range(MAX_RESTARTS):
            if not launcher.is_alive or (folder / STOP_FILE).exists():
                return
            code = _run_worker(study_input, launcher.directory, log_file, signals)
            if signals.is_received and code not in (0, UNAVAILABLE):
                signals.requeue_job()
                return
            if code in ENDS:
                return
            n_errors += code > 0
            if n_errors == MAX_ERRORS:
                return


def _launcher_of(folder: Path) -> ProcessInfo:
    """Return the process that launched this start; raise if this machine does not see its folders."""
    is_seen = (file := folder / LAUNCHER_FILE).exists()
    if is_seen and Path((launcher := ProcessInfo.read(file)).directory).is_dir():
        return launcher
    raise StudyError(
        f"{launcher.directory if is_seen else folder} of the machine that the study was started on cannot be seen from "
        f"{socket.gethostname()}: all machines with workers must share it"
    )


def _run_worker(study_input: bytes, directory: str, log_file: BinaryIO, signals: SlurmSignals) -> int:
    """Run the process of a worker to its end; return its exit code."""
    with subprocess.Popen(
        child_command(__name__, worker_main.__name__),
        stdin=subprocess.PIPE,
        cwd=directory,
        env=_environment(),
        stdout=log_file,
        stderr=log_file,
        start_new_session=True,
    ) as worker:
        signals.forward_to(worker)
        worker.communicate(study_input)
        return worker.returncode


def keep_gpus() -> None:
    """Store the GPUs that this process may use, for workers whose launcher would hide them."""
    os.environ[KEPT_GPUS] = os.environ.get(GPUS, ALL_GPUS)


def _environment() -> dict[str, str]:
    environment = dict(os.environ)
    kept = environment.pop(KEPT_GPUS, None)
    if kept == ALL_GPUS:
        environment.pop(GPUS, None)
    elif kept is not None:
        environment[GPUS] = kept
    return environment


def worker_main(supervisor_pid: int) -> None:
    """Run the process of a worker, which reads its study from standard input.

    Args:
        supervisor_pid: Process ID of its supervisor.
    """
    request = LeaveRequest()
    on_parent_exit(supervisor_pid, request.ask_now)
    overrides, number, folder = pickle.load(sys.stdin.buffer)
    ProcessInfo.current().write(folder / f"worker-{number}.json")
    launcher = ProcessInfo.read(folder / LAUNCHER_FILE)
    # Slurm's come twice: Slurm sends them to all processes of the job, and the supervisor forwards them.
    for sent, ask in ((signal.SIGINT, request.ask_now), (NOW, request.ask_now), (SOON, request.ask_soon)):
        signal.signal(sent, ask)
    # The launcher may have blocked it.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def should_leave() -> bool:
        return request.is_now or not launcher.is_alive or (folder / STOP_FILE).exists()

    from armscan.sweeps.workers.heartbeat import Heartbeat
    from armscan.sweeps.workers.worker import work

    make_heartbeat = partial(
        Heartbeat,
        worker=f"{folder.name}/{number}",
        should_leave=should_leave,
        should_leave_soon=lambda: request.is_soon,
        leave=partial(os._exit, EXIT_INTERRUPTED),
    )
    try:
        work(overrides, make_heartbeat)
    except ArmscanError as error:
        log(str(error))
        raise SystemExit(UNAVAILABLE if isinstance(error, ServiceUnavailableError) else REFUSED) from error

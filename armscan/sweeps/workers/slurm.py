"""Slurm's signals to the job of a worker: to end soon, or now."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from types import FrameType
from typing import Any, Self

from armscan.utils.log import log

# SOON comes before a job's time is over or it is preempted, as submitit requests; NOW when it is cancelled or requeued.
SOON, NOW = signal.SIGUSR2, signal.SIGTERM
ASKING_S = 60


class SlurmSignals:
    """Handlers of Slurm's signals in a job, and the job's reaction.

    Args:
        requeue: Submitit's own handler, which requeues this job and leaves; None outside of Slurm.
    """

    def __init__(self, requeue: Any) -> None:
        self.is_received = False
        self._requeue = requeue
        self._worker: subprocess.Popen[bytes] | None = None

    @classmethod
    @contextlib.contextmanager
    def handled(cls) -> Iterator[Self]:
        """Return a context to supervise a worker in, which handles a Slurm job's signals in place of submitit."""
        if os.environ.get("SUBMITIT_EXECUTOR") != "slurm":
            yield cls(None)
            return
        signals = cls(signal.getsignal(SOON))
        before = {each: signal.signal(each, signals._receive) for each in (SOON, NOW)}
        try:
            yield signals
        finally:
            for each, handler in before.items():
                signal.signal(each, handler)

    def forward_to(self, worker: subprocess.Popen[bytes]) -> None:
        """Forward signals to a worker."""
        self._worker = worker
        if self.is_received:
            worker.terminate()

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.is_received = True
        if self._worker is not None and self._worker.returncode is None:
            os.kill(self._worker.pid, number)

    def requeue_job(self) -> None:
        """Requeue the job, unless Slurm ends it for good.

        In that case return: then the job has a result, and its launcher waits only for the others.

        Raises:
            SystemExit: If the job is requeued; without a result its launcher keeps waiting.
        """
        state, n_restarts = _state()
        if n_restarts > int(os.environ.get("SLURM_RESTART_COUNT", 0)):
            log("Slurm has requeued this job")
            raise SystemExit(1)
        if state == "RUNNING" and callable(self._requeue):
            try:
                # Submitit's own handler, which exits once the job is queued.
                self._requeue(SOON, None)
            except Exception as error:
                log(f"this job could not be requeued: {error!r}")


def _state() -> tuple[str, int]:
    """Return Slurm's state of this job, and how often it has been requeued."""
    variables = ("SLURM_ARRAY_JOB_ID", "SLURM_ARRAY_TASK_ID")
    of_array = [os.environ[each] for each in variables if each in os.environ]
    job = "_".join(of_array) if len(of_array) == len(variables) else os.environ["SLURM_JOB_ID"]
    command = ["scontrol", "show", "job", "--oneliner", job]
    try:
        shown = subprocess.run(command, capture_output=True, text=True, check=False, timeout=ASKING_S).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        log(f"Slurm does not give the state of this job: {error!r}")
        return "", 0
    state, restarts = re.search(r"\bJobState=(\w+)", shown), re.search(r"\bRestarts=(\d+)", shown)
    return state.group(1) if state else "", int(restarts.group(1)) if restarts else 0

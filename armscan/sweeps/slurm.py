"""What Slurm says to the job that a worker runs in: that it is to end soon, or now; and what the job does then."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from types import FrameType
from typing import Any, Self

from armscan.log import say

# Said before a job's time is over or it is preempted, as submitit asks for; and when it is cancelled, or queued again.
SOON, NOW = signal.SIGUSR2, signal.SIGTERM
ASKING_S = 60


class Notice:
    """Whether Slurm has said something, and what is to be done about it.

    Args:
        queue_again: submitit's own handler, which queues this job again and leaves; None outside of Slurm.
    """

    def __init__(self, queue_again: Any) -> None:
        self.is_given = False
        self._queue_again = queue_again
        self._worker: subprocess.Popen[bytes] | None = None

    @classmethod
    @contextlib.contextmanager
    def taken(cls) -> Iterator[Self]:
        """What a worker is supervised in: in a job of Slurm, its signals are taken in the place of submitit."""
        if os.environ.get("SUBMITIT_EXECUTOR") != "slurm":
            yield cls(None)
            return
        notice = cls(signal.getsignal(SOON))
        before = {each: signal.signal(each, notice._take) for each in (SOON, NOW)}
        try:
            yield notice
        finally:
            for each, handler in before.items():
                signal.signal(each, handler)

    def pass_on_to(self, worker: subprocess.Popen[bytes]) -> None:
        """Has a worker told whatever Slurm says, where it does not hear it itself."""
        self._worker = worker
        if self.is_given:
            worker.terminate()

    def _take(self, number: int, frame: FrameType | None) -> None:
        self.is_given = True
        if self._worker is not None and self._worker.returncode is None:
            os.kill(self._worker.pid, number)

    def follow(self) -> None:
        """Ends the job so that it is run again, where Slurm does not mean to end it for good.

        Returns where it does: then the job has a result, and its launcher waits only for the others.

        Raises:
            SystemExit: for a job without a result, for which the launcher waits on.
        """
        state, n_restarts = _state()
        if n_restarts > int(os.environ.get("SLURM_RESTART_COUNT", 0)):
            say("Slurm has queued this job again")
            raise SystemExit(1)
        if state == "RUNNING" and callable(self._queue_again):
            try:
                # Submitit's own: it leaves where the job is queued.
                self._queue_again(SOON, None)
            except Exception as error:
                say(f"this job could not be queued again: {error!r}")


def _state() -> tuple[str, int]:
    """Returns the state of this job and how often it has been queued again, as Slurm says."""
    variables = ("SLURM_ARRAY_JOB_ID", "SLURM_ARRAY_TASK_ID")
    of_array = [os.environ[each] for each in variables if each in os.environ]
    job = "_".join(of_array) if len(of_array) == len(variables) else os.environ["SLURM_JOB_ID"]
    command = ["scontrol", "show", "job", "--oneliner", job]
    try:
        told = subprocess.run(command, capture_output=True, text=True, check=False, timeout=ASKING_S).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        say(f"Slurm does not say what becomes of this job: {error!r}")
        return "", 0
    state, restarts = re.search(r"\bJobState=(\w+)", told), re.search(r"\bRestarts=(\d+)", told)
    return state.group(1) if state else "", int(restarts.group(1)) if restarts else 0

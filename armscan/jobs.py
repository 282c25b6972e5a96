"""One job of a multirun, in a process of its own, started by the launcher's."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback

from omegaconf import DictConfig

from armscan.invocation import Invocation
from armscan.mistakes import mistake_in_one_line
from armscan.multirun import INTERRUPTED, NO_OUTCOME, Job, remove_if_untracked

# What a job's process runs; it may be interrupted while it is still importing.
JOB_PROGRAM = """
try:
    from armscan.jobs import run_job
    run_job()
except KeyboardInterrupt:
    raise SystemExit(130)
"""


def start_job(config: DictConfig, invocation: Invocation, job: Job) -> None:
    """Runs a job in a process of its own.

    One that is killed, for its memory say, takes neither the launcher nor the other jobs with it.
    """
    job.write_outcome(failure=NO_OUTCOME)
    ended = subprocess.run([sys.executable, "-c", JOB_PROGRAM], input=pickle.dumps((config, invocation)), check=False)
    if ended.returncode < 0:
        job.write_outcome(failure=f"killed by {signal.Signals(-ended.returncode).name}: out of memory?")


def run_job() -> None:
    """One job of a multirun, handed over on standard input: a failure is noted, and does not stop the others."""
    threading.Thread(target=_leave_with_parent, args=(os.getppid(),), daemon=True).start()
    config, invocation = pickle.load(sys.stdin.buffer)
    job: Job = invocation.job

    def leave(*_: object) -> None:
        """Ends the job at once: raised inside compiled code, an interrupt can come out as any other error."""
        job.write_outcome(failure=INTERRUPTED)
        os._exit(130)

    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, leave)
    try:
        if job.is_repeated:
            from armscan.repeating import run_again

            figures = run_again(config, invocation, job)
        else:
            from armscan.experiment import run_experiment

            figures = run_experiment(config, invocation)
    except Exception as error:
        line = mistake_in_one_line(error)
        if line is None:
            traceback.print_exc()
        remove_if_untracked(invocation.folder, error)
        print(f"[{job.label}] failed: {line or repr(error)}", file=sys.stderr, flush=True)
        job.write_outcome(failure=line or repr(error))
    else:
        job.write_outcome(figures=figures)


def _leave_with_parent(parent_pid: int) -> None:
    """Ends this process when the one that started it is gone, rather than going on for nobody."""
    while os.getppid() == parent_pid:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)

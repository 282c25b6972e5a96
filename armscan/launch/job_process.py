"""One job of a grid, in its own process, started by the launcher's."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import traceback
from functools import cache, partial
from typing import Any

from omegaconf import DictConfig

from armscan.config.error_messages import one_line_message
from armscan.experiment.job import INTERRUPTED, NO_OUTCOME, Invocation, Job, remove_if_untracked
from armscan.utils.processes import EXIT_INTERRUPTED, ProcessInfo, child_command, interruptions, on_exit, on_parent_exit


def start_job(config: DictConfig, invocation: Invocation, job: Job) -> None:
    """Run a job in its own process.

    If it is killed, for example out of memory, the launcher and the other jobs continue.
    """
    if job.grid.launcher is not None and not job.grid.launcher.is_current:
        _end_with(job.grid.launcher)
    if not job.claims(invocation.folder):
        failure = f"its folder, {invocation.folder}, is another job's: hydra.sweep.subdir must differ between jobs"
        job.write_outcome(failure=failure)
        print(f"[{job.label}] failed: {failure}", file=sys.stderr, flush=True)
        return
    job.write_outcome(failure=NO_OUTCOME)
    command = child_command(__name__, run_job.__name__)
    ended = subprocess.run(command, input=pickle.dumps((config, invocation)), check=False)
    if ended.returncode < 0:
        killed_by = signal.Signals(-ended.returncode)
        question = ": out of memory?" if killed_by == signal.SIGKILL else ""
        job.write_outcome(failure=f"killed by {killed_by.name}{question}")


@cache
def _end_with(launcher: ProcessInfo) -> None:
    """End this process, and so its job, once the grid's launcher has been killed: Joblib's workers would stay."""
    on_exit(launcher, partial(os._exit, 1))


def run_job(launcher_pid: int) -> None:
    """Run one job of a grid, passed on standard input; a failure is recorded and does not stop the others.

    Args:
        launcher_pid: Process ID of its launcher.
    """
    on_parent_exit(launcher_pid, partial(os.kill, os.getpid(), signal.SIGTERM))
    config, invocation = pickle.load(sys.stdin.buffer)
    job: Job = invocation.job
    endings = interruptions()

    def write(**outcome: Any) -> None:
        """Write the outcome; on a full disk, what `start_job` has written stays."""
        try:
            job.write_outcome(**outcome)
        except OSError as error:
            print(f"[{job.label}] its outcome is not kept: {one_line_message(error)}", file=sys.stderr, flush=True)

    def leave(*_: object) -> None:
        """End the job at once, without an exception, which compiled code can turn into any other error."""
        write(failure=INTERRUPTED)
        os._exit(EXIT_INTERRUPTED)

    def end(**outcome: Any) -> None:
        """Write the outcome, and ignore later interrupts."""
        for each in endings:
            signal.signal(each, signal.SIG_IGN)
        write(**outcome)

    for each in endings:
        signal.signal(each, leave)
    try:
        if job.grid.repeats is not None:
            from armscan.launch.resume_grid import run_again

            metrics = run_again(config, invocation, job)
        else:
            from armscan.experiment.runner import run_experiment

            metrics = run_experiment(config, invocation)
    except Exception as error:
        line = one_line_message(error)
        if line is None:
            traceback.print_exc()
        remove_if_untracked(invocation.folder, error)
        print(f"[{job.label}] failed: {line or repr(error)}", file=sys.stderr, flush=True)
        end(failure=line or repr(error))
    else:
        end(metrics=metrics)

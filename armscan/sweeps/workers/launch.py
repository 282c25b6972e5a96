"""Launch the workers of a study on any launcher, wait for them, and leave none behind."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path

from armscan.config.command_hints import armscan_command
from armscan.config.defaults import TRACKING_URI
from armscan.config.literal import hydra_literal
from armscan.config.sources import working_folder
from armscan.errors import ArmscanError, print_error, reason_of
from armscan.launch.launchers import ON_THIS_MACHINE, launcher_error, prepare_launcher
from armscan.sweeps.results.progress import progress_display
from armscan.sweeps.results.study_result import study_result
from armscan.sweeps.results.study_run import best_metrics, result_note
from armscan.sweeps.study.arguments import DEFAULT_LAUNCHER, STORAGE, WORKER_KEY, StudyCommand, fixed_by
from armscan.sweeps.study.dashboard import note_run
from armscan.sweeps.study.phase import OpenedStudy
from armscan.sweeps.workers.heartbeat import LivenessCheck
from armscan.sweeps.workers.monitor import StudyMonitor
from armscan.sweeps.workers.supervisor import LAUNCHER_FILE, STOP_FILE, WORKER_FILES, keep_gpus, local_workers
from armscan.sweeps.workers.trial_run import end_runs_left_open
from armscan.tracking import TrackedRun, sync
from armscan.tracking.run import SHORT_WAIT_S
from armscan.tracking.store import store_errors
from armscan.tracking.sync import IN_USE
from armscan.training.episode_results import TEST_METRICS
from armscan.utils.console import print_sentence
from armscan.utils.processes import ProcessInfo, interruptions
from armscan.utils.retry import no_retry

# Time that workers have to leave before their launcher is interrupted and those on this machine are killed; workers on
# other machines see the request late, through a shared folder.
LEAVE_S, LEAVE_ELSEWHERE_S = 4.0, 20.0
# Ten years: a study has limits of its own.
MINUTES_WITHOUT_END = 5_256_000
Launch = Callable[[Sequence[str]], object]


def run_workers(opened: OpenedStudy, given: StudyCommand, launcher: str, launch: Launch) -> None:
    """Launch the workers of a study, unless nothing is left to do, and wait for their end.

    Args:
        opened: The study.
        given: Command that started it.
        launcher: Choice of `hydra/launcher`.
        launch: Function that launches Hydra's jobs, one for each worker, from arguments of the command line.

    Raises:
        KeyboardInterrupt: If it is interrupted; the workers have been asked to leave.
        ArmscanError: If the launcher has failed, and no worker is alive.
    """
    monitor, search = StudyMonitor(opened), opened.search
    if is_over := monitor.is_over():
        print_sentence(f"study {search.name} in {search.scheduler.storage.uri}: nothing is left to do")
        if _has_finished(opened):
            # Trusted: see `_upload`.
            sync(opened.folder, lambda _: search.store, trust=True)
            for phase in opened.phases:
                end_runs_left_open(phase)
            return
    started = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{socket.gethostname()}_{os.getpid()}"
    folder = working_folder() / opened.folder / "workers" / started
    folder.mkdir(parents=True)
    ProcessInfo.current(str(working_folder())).write(folder / LAUNCHER_FILE)
    arguments = _arguments(opened, given, launcher, folder)
    tracked = TrackedRun.open_existing(search.store, search.run_id, name=opened.settings.name, folder=folder)
    tracked.resume()
    leave_s = LEAVE_S if launcher in ON_THIS_MACHINE else LEAVE_ELSEWHERE_S
    with _leaving(opened, folder, tracked, leave_s, monitor):
        if is_over:
            return
        with progress_display(opened, folder):
            if launcher not in ON_THIS_MACHINE:
                _launch_elsewhere(monitor, folder, launcher, lambda: launch(arguments))
            elif launcher == DEFAULT_LAUNCHER:
                keep_gpus()
                _launch_here(lambda: launch(arguments))
            else:
                launch(arguments)


def _arguments(opened: OpenedStudy, given: StudyCommand, launcher: str, folder: Path) -> list[str]:
    """Return the arguments that the workers are launched with."""
    n_workers, fixed = opened.settings.workers, fixed_by(given.overrides)
    arguments = ["-m", *given.launching]
    # Addresses that only this machine's environment may set.
    addresses = {STORAGE: opened.settings.storage, TRACKING_URI: opened.config.tracking.uri}
    arguments += [f"{key}={hydra_literal(uri)}" for key, uri in addresses.items() if key not in fixed]
    arguments += [
        f"{WORKER_KEY}={','.join(map(str, range(n_workers)))}",
        f"hydra.sweep.dir={hydra_literal(str(folder))}",
    ]
    if launcher == DEFAULT_LAUNCHER:
        # First, so that the user's overrides take precedence.
        arguments.insert(1, f"hydra.launcher.timeout_min={MINUTES_WITHOUT_END}")
    if launcher == "joblib":
        arguments.append(f"hydra.launcher.n_jobs={n_workers}")
    return arguments


def _launch_here(launch: Callable[[], object]) -> None:
    """Launch workers on this machine by submitit, and print which of them was killed with its supervisor."""
    # Deferred: only this launcher loads it.
    from submitit.core.utils import UncompletedJobError

    try:
        with _block_sigint():
            launch()
    # Its trial is requeued; the result says that the study can be resumed.
    except UncompletedJobError as error:
        print_error(f"a worker's supervisor was killed: {reason_of(error)}")


def _launch_elsewhere(monitor: StudyMonitor, folder: Path, launcher: str, launch: Callable[[], object]) -> None:
    """Launch workers on other machines, and wait for the end of the study, even if the launcher fails."""
    prepare_launcher(launcher)
    try:
        with monitor.interrupting():
            launch()
    except SystemExit:
        # Raised by Ray's handler of SIGTERM, which has replaced ours.
        signal.raise_signal(signal.SIGINT)
        monitor.wait_for_requeue()
    # An error from a worker's machine, raised after all workers have ended.
    except ArmscanError as error:
        print_error(str(error))
    # Any error of a launcher, which may fail for one cancelled job while all others continue.
    except Exception as error:
        failed = launcher_error(launcher, error)
        if not any(folder.glob(WORKER_FILES)):
            raise failed from error
        print(f"{failed}; waiting for workers that are still there", file=sys.stderr)
        if not monitor.wait_until_over():
            raise failed from error


@contextlib.contextmanager
def _leaving(
    opened: OpenedStudy, folder: Path, tracked: TrackedRun, leave_s: float, monitor: StudyMonitor
) -> Iterator[None]:
    """Return a context to launch the workers in, which leaves no worker and no open run behind."""
    status, is_asked = None, False

    def ask(*_: object) -> None:
        """Ask the workers to leave before an interrupted launcher may kill them; as a handler, take no lock."""
        nonlocal is_asked
        if is_asked:
            raise KeyboardInterrupt
        is_asked = True
        (folder / STOP_FILE).touch()
        signal.setitimer(signal.ITIMER_REAL, leave_s)

    before = {each: signal.signal(each, ask) for each in (*interruptions(), signal.SIGALRM)}
    try:
        yield
    except BaseException:
        status = "KILLED"
        raise
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for each in before:
            signal.signal(each, signal.SIG_IGN)
        (folder / STOP_FILE).touch()
        _end_workers(folder)
        ended, reason = _conclude(opened, tracked, monitor)
        _upload(opened, monitor, tracked, "KILLED" if is_asked else status or ended, reason)
        for each, handler in before.items():
            signal.signal(each, handler)
    if is_asked:
        raise KeyboardInterrupt


def _conclude(opened: OpenedStudy, tracked: TrackedRun, monitor: StudyMonitor) -> tuple[str, str | None]:
    """Reclaim the trials of dead workers, and track the result; return the status of the study's run, and why."""
    failure, stopped, is_left = None, "", True
    # If the storage is unavailable, the next start does it; if it is damaged, the result says so.
    with contextlib.suppress(ArmscanError), no_retry():
        for phase in opened.phases:
            for trial in phase.scheduler.reclaim(LivenessCheck().is_dead):
                phase.close_runs_of(trial)
            failure = failure or phase.scheduler.failure_reason(phase.scheduler.state())
            stopped = stopped or phase.scheduler.read_stop_request()
        # Workers of another command may go on with it.
        is_left = not (monitor.is_over() or monitor.is_worked_on())
        search = opened.search.scheduler.study
        result = study_result(opened.final_eval) if opened.final_eval is not None else None
        note = result_note(result)
        # While a study that goes on has no new result, its run keeps all of the earlier one.
        if note or not _has_result(opened):
            tracked.log_metrics(best_metrics(search, result), n_env_steps=0, keeps_nan=True)
        if note:
            tracked.set_description(note)
            note_run(
                search, opened.search.store, opened.search.experiment_id, opened.search.run_id, opened.folder, note
            )
    if failure:
        return "FAILED", failure
    if stopped:
        return "KILLED", f"stopped {stopped}"
    return ("KILLED", "its workers have ended; the same command resumes it") if is_left else ("FINISHED", None)


def _has_finished(opened: OpenedStudy) -> bool:
    """Return whether the study's run has ended with its result."""
    store = opened.search.store
    with store_errors(store.uri):
        return str(store.get_run(opened.search.run_id).info.status) == "FINISHED"


def _has_result(opened: OpenedStudy) -> bool:
    """Return whether the study's run has the metrics of a result, perhaps an earlier one."""
    store = opened.search.store
    with store_errors(store.uri):
        metrics = store.get_run(opened.search.run_id).data.metrics
    return any(name.startswith(f"{TEST_METRICS}/") for name in metrics)


def _upload(opened: OpenedStudy, monitor: StudyMonitor, tracked: TrackedRun, status: str, reason: str | None) -> None:
    """End the study's own run, and upload what its trials buffered while their store was unavailable."""
    is_there = tracked.end(status, reason=reason, wait_s=SHORT_WAIT_S if status == "KILLED" else None)
    left = []
    if is_there:
        # Trusted: anyone who may write into the folder of a study can execute code in it anyway.
        uploads = sync(opened.folder, lambda _: opened.search.store, trust=True)
        # Runs in use are those of another command, which uploads them.
        left = [each.folder for each in uploads if each.left not in (None, IN_USE)]
        store = opened.search.store
        with contextlib.suppress(ArmscanError), no_retry(), store_errors(store.uri):
            for phase in opened.phases:
                end_runs_left_open(phase)
                phase.close_orphaned_runs()
            if monitor.is_worked_on():
                store.update_run(opened.search.run_id, status="RUNNING")
    if not is_there or left:
        print(
            f"not everything was uploaded: {armscan_command('runs', 'sync', str(opened.folder))} uploads the rest",
            file=sys.stderr,
        )


@contextlib.contextmanager
def _block_sigint() -> Iterator[None]:
    """Keep a Ctrl-C from a launcher's processes, which would each print a traceback.

    They inherit this thread's blocked SIGINT. Another thread receives the signal, and this one is interrupted within a
    second.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_workers(folder: Path) -> None:
    """Wait for the workers on this machine to leave, kill those that do not, and wait for their end."""
    if alive := _still_alive(folder):
        for worker in alive:
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.pid, signal.SIGKILL)
        _still_alive(folder)


def _still_alive(folder: Path) -> list[ProcessInfo]:
    """Wait for the workers on this machine to end; return those that are alive after `LEAVE_S`."""
    until_s = time.monotonic() + LEAVE_S
    while (alive := local_workers(folder)) and time.monotonic() < until_s:
        time.sleep(0.05)
    return alive

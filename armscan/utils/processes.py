"""Processes: compute threads, garbage collection, whether a process is still alive, and the exit of the parent."""

from __future__ import annotations

import atexit
import gc
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Self

import psutil

from armscan.utils.files import atomic_write

POLL_S = 0.5
# Exit code of a process that Ctrl-C has ended.
EXIT_INTERRUPTED = 130
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def limit_threads() -> None:
    """Limit this process to one compute thread, unless the user set a number; call it before libraries start pools.

    Small networks are fastest with one thread, and parallel jobs never claim more threads than there are cores.
    """
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")


def n_usable_cores() -> int:
    """Return the number of cores that this process may use."""
    # macOS has no affinity.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def collect_garbage_rarely() -> None:
    """Collect cyclic garbage after 50,000 new objects, not after 700, and not at the exit of the process.

    Libraries make some hundred thousand permanent objects. Scanning them again and again takes half a second of a
    command's three, and three seconds at the end of a run.
    """
    gc.set_threshold(50_000)
    atexit.register(gc.freeze)


def discard_output() -> None:
    """Discard what is still printed: the reader of this process's output, such as `head`, has ended."""
    # Otherwise the interpreter fails on exit, when it writes the rest.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def interruptions() -> list[signal.Signals]:
    """Return the signals that end a process like Ctrl-C: also that of a closed terminal, unless `nohup` ignores it."""
    closed = [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN else []
    return [signal.SIGINT, signal.SIGTERM, *closed]


def end_like_ctrl_c() -> None:
    """End this process like Ctrl-C, which Python handles itself, when it is told to end or its terminal is closed."""
    for each in interruptions():
        if each != signal.SIGINT:
            signal.signal(each, signal.default_int_handler)


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect no garbage inside the context, while permanent objects are made, and never scan these again."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def child_command(module: str, function: str) -> list[str]:
    """Return the command of a child process, which exits cleanly if it is interrupted during its imports.

    Args:
        module: Name of the function's module.
        function: Name of the function to call with the ID of this process.
    """
    first = collect_garbage_rarely.__name__
    steps = (
        f"from {__name__} import {first}",
        f"{first}()",
        f"from {module} import {function}",
        f"{function}({os.getpid()})",
    )
    program = "\n    ".join(("try:", *steps))
    return [sys.executable, "-c", f"{program}\nexcept KeyboardInterrupt:\n    raise SystemExit({EXIT_INTERRUPTED})"]


def process_start(pid: int) -> str:
    """Return the start time of a process, which tells it from a later one with the same ID, however the clock is set.

    Returns:
        Seconds since boot (Linux) or since 1970, as a string; empty if there is no such process, or only a zombie.
    """
    try:
        process = psutil.Process(pid)
        if process.status() == psutil.STATUS_ZOMBIE:
            return ""
        return f"{_seconds_from_boot_to_start(pid) if psutil.LINUX else process.create_time():.2f}"
    # Also if `pid` is not a process ID.
    except (psutil.Error, OSError, TypeError, ValueError):
        return ""


def _seconds_from_boot_to_start(pid: int) -> float:
    """Return the start time of a process on Linux (proc(5)); psutil adds the boot time, which moves with the clock."""
    # The name of the program, in brackets, may have spaces; the start is the 20th field after it.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[19]) / os.sysconf("SC_CLK_TCK")


def _boot_and_pid_namespace() -> tuple[str, str]:
    """Return the boot ID and the PID namespace, which tell processes of hosts with the same name apart."""
    if not psutil.LINUX:
        return "any", "any"
    try:
        # /proc, in which processes are looked up, may belong to another namespace.
        is_own = str(Path("/proc/self").readlink()) == str(os.getpid())
        return BOOT_ID.read_text().strip(), str(Path("/proc/self/ns/pid").readlink()) if is_own else ""
    except OSError:
        return "", ""


@dataclass(frozen=True)
class ProcessInfo:
    """A process, so that others can tell whether it is still alive.

    Containers and machines may share a host name; a process ID means something only in one boot and PID namespace.

    Args:
        host: Name of the machine that it runs on.
        pid: Process ID on that machine.
        started: Start time, see `process_start`; empty for no process.
        directory: Working directory; empty if it is not needed.
        boot: ID of the machine's boot; empty if it is not known, as in records of earlier versions.
        pid_namespace: PID namespace of its process ID; empty if it is not known.
    """

    host: str
    pid: int
    started: str
    directory: str = ""
    boot: str = ""
    pid_namespace: str = ""

    @classmethod
    def current(cls, directory: str = "") -> Self:
        """Return the current process."""
        pid = os.getpid()
        return cls(socket.gethostname(), pid, process_start(pid), directory, *_boot_and_pid_namespace())

    @classmethod
    def read(cls, file: Path) -> Self:
        """Return the process that a file describes."""
        return cls.of(json.loads(file.read_text()))

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Return the process that a mapping, possibly of an earlier version, describes; other keys are ignored."""
        nobody: dict[str, Any] = {"host": "", "pid": 0, "started": ""}
        return cls(**nobody | {each.name: values[each.name] for each in fields(cls) if each.name in values})

    def write(self, file: Path) -> None:
        """Write it to a file."""
        atomic_write(file, json.dumps(asdict(self)))

    @property
    def is_here(self) -> bool:
        """Return whether this process can see it, and so knows whether it is alive."""
        own = (socket.gethostname(), *_boot_and_pid_namespace())
        return all(own) and own == (self.host, self.boot, self.pid_namespace)

    @property
    def is_alive(self) -> bool:
        """Return whether it has not ended; a process that cannot be seen from here counts as alive."""
        return not self.is_here or process_start(self.pid) == self.started != ""

    @property
    def is_current(self) -> bool:
        """Return whether it is the current process."""
        return self.is_here and self.pid == os.getpid()


def on_parent_exit(parent_pid: int, action: Callable[[], object]) -> None:
    """Call `action` in a thread once the parent process has ended.

    Args:
        parent_pid: ID of the parent, as `child_command` passes it: it may have ended during this process's imports.
        action: Function to call.
    """
    _when_false(lambda: os.getppid() == parent_pid, action)


def on_exit(process: ProcessInfo, action: Callable[[], object]) -> None:
    """Call `action` in a thread once a process has ended; never if it cannot be seen from here."""
    _when_false(lambda: process.is_alive, action)


def _when_false(condition: Callable[[], bool], action: Callable[[], object]) -> None:
    def watch() -> None:
        while condition():
            time.sleep(POLL_S)
        action()

    threading.Thread(target=watch, daemon=True).start()

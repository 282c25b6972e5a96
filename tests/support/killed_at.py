"""A program that runs commands in processes that kill themselves at a chosen moment, as `kill -9` would.

Each line of its input is an order: the command's words, and the moment. The libraries are loaded once, and each command
runs in a fork, whose output goes to the file `printed`. The answer is a line with its exit code.
"""

from __future__ import annotations

import functools
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.support import REPOSITORY


@dataclass(frozen=True)
class Moment:
    """The moment at which a process kills itself.

    Args:
        place: Function or method, such as `torch.optim:Adam.step`.
        number: Number of the call that ends the process, from 1.
        delay_s: Seconds after the start of that call, but at the latest when it returns. Default: None, before the
            call.
    """

    place: str
    number: int = 1
    delay_s: float | None = None

    def wait(self) -> None:
        """Make this process kill itself at that moment."""
        module, _, path = self.place.partition(":")
        *owners, name = path.split(".")
        owner: Any = functools.reduce(getattr, owners, importlib.import_module(module))
        own, n_calls = getattr(owner, name), 0

        @functools.wraps(own)
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal n_calls
            n_calls += 1
            if n_calls == self.number and self.delay_s is None:
                _kill()
            if n_calls == self.number:
                threading.Timer(self.delay_s or 0.0, _kill).start()
            result = own(*args, **kwargs)
            if n_calls == self.number:
                _kill()
            return result

        setattr(owner, name, call)


def _kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


class Commands:
    """Runner of commands.

    Args:
        process: Process of this module.
    """

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def run(self, words: Sequence[str], moment: Moment | None = None) -> int:
        """Run a command; return its exit code, minus the signal that killed it."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        order = {"words": list(words), "moment": asdict(moment) if moment else None}
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())


@contextmanager
def commands(folder: Path) -> Iterator[Commands]:
    """Yield a runner of commands in a folder; end its process at the end of the block."""
    program = [sys.executable, "-m", "tests.support.killed_at"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(REPOSITORY), *sys.path])}
    with subprocess.Popen(
        program, cwd=folder, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield Commands(process)
        process.kill()


def _answer_orders() -> None:
    from armscan.run import main

    for module in ("armscan.launch.resume", "armscan.launch.multirun", "armscan.training.video"):
        importlib.import_module(module)
    for line in sys.stdin:
        order = json.loads(line)
        child = os.fork()
        if child == 0:
            printed = os.open("printed", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            for stream in (sys.stdout, sys.stderr):
                os.dup2(printed, stream.fileno())
            if order["moment"]:
                Moment(**order["moment"]).wait()
            sys.argv[1:] = order["words"]
            sys.exit(main())
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    _answer_orders()

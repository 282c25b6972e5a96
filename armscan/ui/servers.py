"""Servers for the browser of this machine, as child processes that end with this one."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import IO

from armscan.config.credentials import mask_passwords
from armscan.errors import InvalidValueError, ServerError

HOST = "127.0.0.1"
START_S, END_S, POLL_S = 120.0, 5.0, 0.1
LOG_BYTES = 2000


@dataclass(frozen=True, kw_only=True)
class Server:
    """A server to start.

    Args:
        title: name of the program, for messages.
        program: name of the program in `armscan.ui.serve`.
        arguments: the program's arguments after the port.
        option: command-line option that sets the port.
        port: port on 127.0.0.1.
    """

    title: str
    program: str
    arguments: tuple[str, ...]
    option: str
    port: int

    @property
    def address(self) -> str:
        """URL for the browser."""
        return f"http://{HOST}:{self.port}"

    def check_port(self) -> None:
        """Raise `InvalidValueError` if the port cannot be used."""
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, self.port))
            except OSError as error:
                why = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
                raise InvalidValueError(
                    f"{self.option} is {self.port}, but that port of {HOST} {why}: give another"
                ) from error


class ServerProcess:
    """A running server.

    Args:
        server: server to start.
        log: receives the output.
    """

    def __init__(self, server: Server, log: IO[bytes]) -> None:
        self.server, self._log = server, log
        # A session, thus a process group, of its own: Ctrl-C reaches only this process. It ends when its standard input
        # is closed, also by the death of this process.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "armscan.ui.serve", server.program, str(server.port), *server.arguments],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )

    def wait_until_answering(self, processes: Sequence[ServerProcess]) -> None:
        """Wait until the server answers.

        Args:
            processes: the processes that must stay alive meanwhile.

        Raises:
            ServerError: if it does not answer in time, or one of the processes has ended.
        """
        until_s = time.monotonic() + START_S
        while not self._is_answering():
            for each in processes:
                each.check()
            if time.monotonic() > until_s:
                raise self._error(f"does not answer within {START_S:g} s of its start")
            time.sleep(POLL_S)

    def check(self) -> None:
        """Raise `ServerError` if the server has ended."""
        code = self._process.poll()
        if code is not None:
            how = f"with exit code {code}" if code >= 0 else f"by {signal.Signals(-code).name}"
            raise self._error(f"has ended by itself, {how}")

    def ask_to_end(self) -> None:
        """Ask the server to end, by closing its standard input."""
        assert self._process.stdin is not None
        self._process.stdin.close()

    def end(self) -> None:
        """Wait until the server has ended, and kill what is left of its process group."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def _is_answering(self) -> bool:
        try:
            socket.create_connection((HOST, self.server.port), timeout=POLL_S).close()
        except OSError:
            return False
        return True

    def _error(self, what: str) -> ServerError:
        self._log.seek(max(0, self._log.seek(0, os.SEEK_END) - LOG_BYTES))
        log = mask_passwords(self._log.read().decode(errors="replace"))
        return ServerError(f"{self.server.title} {what}", log=log.strip())


@contextlib.contextmanager
def running(servers: Sequence[Server]) -> Iterator[list[ServerProcess]]:
    """Run servers for as long as the context lasts."""
    with contextlib.ExitStack() as logs:
        processes: list[ServerProcess] = []
        try:
            processes.extend(ServerProcess(each, logs.enter_context(tempfile.TemporaryFile())) for each in servers)
            yield processes
        finally:
            for process in processes:
                process.ask_to_end()
            for process in processes:
                process.end()

"""Servers that a command starts beside itself, for this machine alone: processes that are gone with the command."""

from __future__ import annotations

import contextlib
import errno
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import IO, Any

from armscan.errors import InvalidValueError, ServerError

HOST = "127.0.0.1"
START_S, END_S, ANSWER_S, PAUSE_S = 120.0, 5.0, 5.0, 0.1
LOG_BYTES = 2000


@dataclass(frozen=True, kw_only=True)
class Server:
    """What is served, and where.

    Args:
        program: one of those in `armscan.serving`.
        title: of it, for messages.
        port_key: by which the user gives the port.
        port: that it answers on.
        health: what it is asked to know whether it answers.
        told: the other arguments of the program.
        hint: for who opens it, beside its address.
        secrets: what must not be shown of its log.
    """

    program: str
    title: str
    port_key: str
    port: int
    health: str
    told: Mapping[str, Any] = field(repr=False)
    secrets: Collection[str] = field(repr=False)
    hint: str = ""

    @property
    def address(self) -> str:
        """For the browser."""
        return f"http://{HOST}:{self.port}"

    def check_port(self) -> None:
        """Raises `InvalidValueError` where the port cannot be used."""
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, self.port))
            except OSError as error:
                why = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
                key = self.port_key
                raise InvalidValueError(
                    f"{key} is {self.port}, but that port of {HOST} {why}: give another, {key}=NUMBER"
                ) from error


class Process:
    """A server that has been started.

    Args:
        server: to start.
        log: takes what it says.
    """

    def __init__(self, server: Server, log: IO[bytes]) -> None:
        self.server, self._log = server, log
        # In a session of its own: a Ctrl-C reaches only who has started it, and its own processes are in one group.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "armscan.serving", server.program],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        # One that has ended already is found out when it is waited for.
        with contextlib.suppress(BrokenPipeError):
            # Nobody else reads it, and it stays open: its end tells the server that this process is gone.
            self._process.stdin.write(json.dumps({**server.told, "port": server.port}).encode() + b"\n")
            self._process.stdin.flush()

    def is_answering(self) -> bool:
        """Whether it answers."""
        # Whatever proxy there is, it is not for this machine.
        direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        return _answers(direct, self.server.address + self.server.health)

    def check(self) -> None:
        """Raises `ServerError` if it has ended."""
        code = self._process.poll()
        if code is not None:
            how = f"with exit code {code}" if code >= 0 else f"by {signal.Signals(-code).name}"
            raise self.error(f"has ended by itself, {how}")

    def error(self, what: str) -> ServerError:
        """Returns the error of what has happened to it."""
        self._log.seek(max(0, self._log.seek(0, os.SEEK_END) - LOG_BYTES))
        log = without(self.server.secrets, self._log.read().decode(errors="replace"))
        return ServerError(f"{self.server.title} {what}", log=log.strip())

    def ask_to_end(self) -> None:
        """Asks it and its own processes to end."""
        self._tell(signal.SIGTERM)

    def end(self) -> None:
        """Waits until it has ended, but not for long."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
        self._tell(signal.SIGKILL)
        # Waits, and closes its standard input.
        self._process.communicate()

    def _tell(self, number: signal.Signals) -> None:
        # The whole group, of which some may be left when the first is gone.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)


@contextlib.contextmanager
def running(servers: Sequence[Server]) -> Iterator[list[Process]]:
    """Servers as long as it lasts: started, and ended, side by side."""
    with _signals_interrupt(), contextlib.ExitStack() as logs:
        processes: list[Process] = []
        try:
            # One after the other: where one cannot be started, those before it are in the list, and are ended.
            processes.extend(Process(each, logs.enter_context(tempfile.TemporaryFile())) for each in servers)
            yield processes
        finally:
            for process in processes:
                process.ask_to_end()
            for process in processes:
                process.end()


@contextlib.contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Turns whatever tells this process to end into an interrupt; those after the first hurry nobody."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    # What is ignored already, as under nohup, stays so.
    heeded = [number for number, handler in before.items() if handler != signal.SIG_IGN]

    def interrupt(*_: object) -> None:
        for number in heeded:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in heeded:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in heeded:
            signal.signal(number, before[number])


def wait_until_answering(process: Process, processes: Sequence[Process]) -> None:
    """Waits until a server answers.

    Args:
        process: of the server.
        processes: all that must go on meanwhile.

    Raises:
        ServerError: if it does not answer in time, or one of all has ended.
    """
    until_s = time.monotonic() + START_S
    while not process.is_answering():
        for each in processes:
            each.check()
        if time.monotonic() > until_s:
            raise process.error(f"does not answer within {START_S:g} s of its start")
        time.sleep(PAUSE_S)


def watch(processes: Sequence[Process]) -> None:
    """Goes on until a server has ended, which is a `ServerError`, or this process is interrupted."""
    while True:
        for process in processes:
            process.check()
        time.sleep(PAUSE_S)


def without(secrets: Collection[str], text: str) -> str:
    """Returns a text without secrets."""
    for secret in secrets:
        text = text.replace(secret, "***")
    return text


def is_answered(address: str) -> bool:
    """Whether a server answers, on whichever machine it is."""
    return _answers(urllib.request.build_opener(), address)


def _answers(opener: urllib.request.OpenerDirector, address: str) -> bool:
    try:
        opener.open(address, timeout=ANSWER_S).close()
    except urllib.error.HTTPError as error:
        # It does, if only to those that it knows.
        return error.code < http.client.INTERNAL_SERVER_ERROR
    except (OSError, http.client.HTTPException):
        return False
    return True

"""Functions that Numba compiles: their cache, and a log line when compilation, which takes a while, begins."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from hashlib import sha256
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType
from typing import Any, TypeVar, cast

import numba
from filelock import FileLock
from numba.core.event import Event, Listener, install_listener

from armscan.utils.log import log
from armscan.utils.processes import interruptions

PACKAGE = Path(__file__).parents[1]
LOCK_FILE = ".lock"
Function = TypeVar("Function", bound=Callable[..., Any])
# Modules whose attributes no type checker sees.
CONFIG: Any = numba.config
EVENTS: Any = numba.core.event


def cached_njit(**options: Any) -> Callable[[Function], Function]:
    """Return `numba.njit` with a cache that is invalidated if any file with compiled functions has changed.

    Numba itself checks only the file of a function, not those of the compiled functions that it calls, and would keep
    their old code.

    Args:
        options: Options of `numba.njit` beside `cache`.
    """

    def compiled(function: Function) -> Function:
        # The user's own setting, such as NUMBA_CACHE_DIR, is restored for other packages' functions.
        before = CONFIG.CACHE_DIR
        CONFIG.CACHE_DIR = str(Path(before or PACKAGE / "__pycache__") / f"armscan-{_sources_sha256()}")
        try:
            dispatcher = numba.njit(cache=True, **options)(function)
        finally:
            CONFIG.CACHE_DIR = before
        _lock_cache(dispatcher)
        return cast(Function, dispatcher)

    return compiled


def _lock_cache(dispatcher: Any) -> None:
    """Let one process at a time write the cache of a function.

    Two processes that compile it for different types would otherwise write both results to the same file.
    """
    # Without compilation (NUMBA_DISABLE_JIT) there is no cache.
    if (kept := getattr(dispatcher, "_cache", None)) is None:
        return
    folder, save = Path(kept.cache_path), kept.save_overload

    def save_alone(*args: Any) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / LOCK_FILE):
            save(*args)

    kept.save_overload = save_alone


@cache
def _sources_sha256() -> str:
    """Return the first 16 digits of the SHA-256 of all files with compiled functions."""
    sources = (file.read_bytes() for file in sorted(PACKAGE.rglob("*.py")))
    return sha256(b"".join(source for source in sources if b"njit" in source)).hexdigest()[:16]


@contextmanager
def log_compilation(text: str, matches: Callable[[Any], bool]) -> Iterator[None]:
    """Log a text once inside the context, when Numba begins to compile a function that its cache does not have.

    Args:
        text: Text to log.
        matches: Function that returns whether a Numba dispatcher is among the functions that the text is about.
    """
    with install_listener("numba:compile", _Note(text, matches)):
        yield


class _Note(Listener):
    def __init__(self, text: str, matches: Callable[[Any], bool]) -> None:
        self._text, self._matches, self._is_told = text, matches, False

    def on_start(self, event: Event) -> None:
        if not self._is_told and self._matches(event.data["dispatcher"]):
            self._is_told = True
            log(self._text)

    def on_end(self, event: Event) -> None:
        pass


class _DeferredSignals(Listener):
    """Defers Ctrl-C, and signals like it, during a compilation: LLVM's callbacks lose exceptions, and compiling fails.

    A second signal is handled at once.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._handlers: dict[int, Callable[..., object]] = {}
        self._received: tuple[int, FrameType | None] | None = None

    def on_start(self, event: Event) -> None:
        if current_thread() is not main_thread():
            return
        if self._depth == 0:
            found = {each: signal.getsignal(each) for each in interruptions()}
            self._handlers = {number: handler for number, handler in found.items() if callable(handler)}
            for number in self._handlers:
                signal.signal(number, self._receive)
        self._depth += 1

    def on_end(self, event: Event) -> None:
        if current_thread() is not main_thread():
            return
        self._depth -= 1
        if self._depth == 0:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            if self._received is not None:
                (number, frame), self._received = self._received, None
                self._handlers[number](number, frame)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self._received is None:
            self._received = number, frame
        else:
            self._handlers[number](number, frame)


EVENTS.register("numba:compile", _DeferredSignals())

"""A line in the log when code is compiled for the first time on a machine, because that takes a while."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core.event import Event, Listener, install_listener

from armscan.utils.log import log


@contextmanager
def compilation_told(text: str, is_meant: Callable[[Any], bool]) -> Iterator[None]:
    """Log a text inside the context when a function begins to be compiled, once; numba's cache then has it.

    Args:
        text: Text to log.
        is_meant: Function that says whether a numba dispatcher is among the functions that the text is about.
    """
    with install_listener("numba:compile", _Note(text, is_meant)):
        yield


class _Note(Listener):
    def __init__(self, text: str, is_meant: Callable[[Any], bool]) -> None:
        self._text, self._is_meant, self._is_told = text, is_meant, False

    def on_start(self, event: Event) -> None:
        if not self._is_told and self._is_meant(event.data["dispatcher"]):
            self._is_told = True
            log(self._text)

    def on_end(self, event: Event) -> None:
        pass

"""Commands that take `key=value` words: their reading, and how a mistake or an interrupt ends."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Sequence
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from armscan.errors import InvalidValueError, is_interruption, listed
from armscan.passwords import check_words
from armscan.services import hand_over_local


def read_words(words: Sequence[str], allowed: Sequence[str], texts: Collection[str]) -> dict[str, Any]:
    """Returns the values of `key=value` words by key; of a key that is given twice, the last.

    Args:
        words: of the command line.
        allowed: the keys.
        texts: those whose values are taken as they are written, whatever a path looks like; lists, numbers and truth
            values of the others are parsed.

    Raises:
        InvalidValueError: if a word is something else, a key unknown, or a value empty or unreadable.
    """
    pairs: dict[str, str] = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals:
            raise InvalidValueError(f"{word!r} cannot be read: give key=value, with a key of {listed(allowed)}")
        if key not in allowed:
            raise InvalidValueError(f"there is no key {key!r}, but only {listed(allowed)}")
        if not text:
            raise InvalidValueError(f"{key} is empty, but it must have a value")
        pairs[key] = text
    return {key: text if key in texts else _parsed(key, text) for key, text in pairs.items()}


def _parsed(key: str, text: str) -> Any:
    word = f"{key}={text}"
    try:
        values: Any = OmegaConf.to_container(OmegaConf.from_dotlist([word]), resolve=True)
    except (OmegaConfBaseException, YAMLError) as error:
        raise InvalidValueError(f"{word!r} cannot be read ({' '.join(str(error).split())})") from error
    return values[key]


def answered(command: Callable[[Sequence[str]], int], words: Sequence[str] | None, *, usage: str, left: str) -> int:
    """Runs a command for what the command line says; returns the exit code.

    Args:
        command: takes the words and returns the exit code.
        words: of the command line; the process's own where they are None.
        usage: what `--help` prints.
        left: what an interrupt leaves, told to whoever interrupted.
    """
    words = sys.argv[1:] if words is None else words
    if {"-h", "--help"} & set(words):
        print(usage)
        return 0
    try:
        check_words(words)
        hand_over_local()
        return command(words)
    # Raised inside compiled code, an interrupt can come out as any other error.
    except (KeyboardInterrupt, Exception) as error:
        if is_interruption(error):
            print(f"\ninterrupted; {left}", file=sys.stderr)
            return 130
        # Deferred: it loads Hydra, which only who has made a mistake needs here.
        from armscan.mistakes import mistake_in_one_line

        line = mistake_in_one_line(error, words)
        if line is None:
            raise
        print(f"error: {line}", file=sys.stderr)
        return 2

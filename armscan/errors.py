"""The errors armscan raises for a caller's mistake, in one small hierarchy.

Each message is one line that names the value received, what is allowed, and where the value came from.
"""

from __future__ import annotations

import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator

# Maximum length of a library's error text in a message.
MAX_REASON_CHARS = 300
# Control characters, line separators, bidirectional formatting characters and lone surrogates.
CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


class ArmscanError(Exception):
    """Base of every error that armscan raises on purpose."""

    def __str__(self) -> str:
        """Return the message in one line, even if a received value, such as an array, has several."""
        return printable(" ".join(line.strip() for line in super().__str__().splitlines()))


def print_error(message: str) -> None:
    """Print an error message, wrapped between words on a terminal, and on one line in a file or pipe."""
    line = printable(f"error: {message}")
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns
        line = textwrap.fill(line, width, break_long_words=False, break_on_hyphens=False)
    print(line, file=sys.stderr)


class InvalidValueError(ArmscanError, ValueError):
    """An argument or configuration value is not allowed."""


class VolumeError(ArmscanError, ValueError):
    """A file or array cannot serve as a labelmap volume."""


class ManifestError(ArmscanError, ValueError):
    """The manifest of a dataset is damaged or disagrees with the files beside it."""


class MarkupError(ArmscanError, ValueError):
    """A markups file of 3D Slicer cannot be read or written, or no agent can move to its plane."""


class OptimalPlaneError(ArmscanError, ValueError):
    """A volume's labelled plane is missing, out of bounds, or does not show the landmarks."""


class ResetNeededError(ArmscanError, RuntimeError):
    """An environment was stepped or rendered without a running episode."""


class ExportError(ArmscanError, RuntimeError):
    """A policy cannot be exported as a model, or the model acts differently from the agent."""


class DivergedError(ArmscanError, ArithmeticError):
    """Training has diverged: some weights are not finite."""


class CheckpointError(ArmscanError, ValueError):
    """A checkpoint cannot be read, or belongs to another agent."""


class ChangedVolumesError(ArmscanError, ValueError):
    """The volumes differ from those that the run or checkpoint was made with."""


class FolderInUseError(ArmscanError, RuntimeError):
    """Another process is using a run's folder."""


class FolderTakenError(ArmscanError, ValueError):
    """The folder of a new run contains a file, not made by a run, that the run would overwrite."""


class ResumeError(ArmscanError, RuntimeError):
    """A run cannot be resumed."""


class UntrustedError(ArmscanError, RuntimeError):
    """Acting on a stored value, which anybody may have written, is unsafe."""


class DisplayError(ArmscanError, RuntimeError):
    """No screen, notebook or library is available to show a window."""


class ServiceUnavailableError(ArmscanError, RuntimeError):
    """A service is unavailable, and is not retried any further."""


class TrackingError(ArmscanError, RuntimeError):
    """The tracking store cannot be reached or used."""


class TrackingUnavailableError(TrackingError, ServiceUnavailableError):
    """The tracking store is unavailable, and is not retried any further."""


class StudyError(ArmscanError, RuntimeError):
    """A study cannot be started or resumed."""


class StorageUnavailableError(StudyError, ServiceUnavailableError):
    """The storage of a study is unavailable, and is not retried any further."""


def with_causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error, and those that it follows from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def is_interruption(error: BaseException) -> bool:
    """Return whether an error is or follows from a `KeyboardInterrupt`, which compiled code can turn into any error."""
    return any(isinstance(each, KeyboardInterrupt) for each in with_causes(error))


def in_one_line(text: object) -> str:
    """Return a text in one line, with single spaces."""
    return " ".join(str(text).split())


def reason_of(error: BaseException) -> str:
    """Return the text of an error in one line, of at most `MAX_REASON_CHARS` characters; its `repr` if it has none."""
    return (in_one_line(error) or repr(error))[:MAX_REASON_CHARS]


def listed(allowed: Iterable[object]) -> str:
    """Return the allowed values, joined for a message: 'a, b or c', or 'nothing'."""
    *others, last = [str(value) for value in allowed] or ["nothing"]
    return f"{', '.join(others)} or {last}" if others else last


def few(names: Iterable[object], most: int = 4) -> str:
    """Return the first few of possibly many names for a message: 'a, b, c, d and 96 more'."""
    texts = [str(name) for name in names]
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more" if len(texts) > most else "")


def printable(text: str) -> str:
    """Return a string that is safe to show in a terminal: control characters are escaped."""
    return CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)

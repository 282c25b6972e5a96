"""Numbers, rates, tables and names as text."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence

# Short form of a rate.
PERCENT = "{:.0%}"
# Shown in place of a value that there is none of.
MISSING = "–"


def formatted(form: str, value: float) -> str:
    """Format a value, for instance by `{:.1%}`; instead of rounding to 0 or 100 %, a rate is `<0.1%` or `>99.9%`.

    A negative value that rounds to 0 has no sign.
    """
    text = form.format(value)
    if text.startswith("-") and is_zero(text):
        text = text[1:]
    if form.endswith("%}") and 0.0 < value < 1.0:
        smallest = 10.0 ** -(len(text.partition(".")[2].rstrip("%")) + 2)
        for bound, sign, nearest in ((0.0, "<", smallest), (1.0, ">", 1.0 - smallest)):
            if text == form.format(bound):
                return sign + form.format(nearest)
    return text


def is_zero(text: str) -> bool:
    """Return whether a number, as it is shown, is 0."""
    return "0" in text and not any(digit in text for digit in "123456789")


def counted(number: int, what: str) -> str:
    """Return a number with its noun, such as `1 seed` or `3 seeds`."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def appearance(name: str) -> str:
    """Return a name without invisible characters, and in one Unicode form: names copied from a Mac have another."""
    return "".join(each for each in unicodedata.normalize("NFKC", name) if unicodedata.category(each) != "Cf")


def looks_like_one_of(name: str, known: Iterable[str]) -> bool:
    """Return whether a name looks like another one."""
    return any(name != each and appearance(name) == appearance(each) for each in known)


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown; its first column is aligned to the left, the others to the right."""
    lines = [columns, ["---", *("---:" for _ in columns[1:])], *rows]
    return "\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines)


def _cell(text: str) -> str:
    """Return the text of a cell of a Markdown table: a bar or a line break would end the cell."""
    return " ".join(text.replace("|", r"\|").splitlines())


def format_duration(seconds: float | None) -> str:
    """Format a duration, such as 1:05:10 or 3d 4h."""
    if seconds is None:
        return MISSING
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours >= 24:
        return f"{hours // 24}d {hours % 24}h"
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"

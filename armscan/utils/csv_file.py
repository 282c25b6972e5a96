"""CSV files that a spreadsheet shows and never executes."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TextIO

from armscan.errors import printable

# First characters of what a spreadsheet takes for a formula, full-width ones included.
FORMULA = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")


def write_csv(file: TextIO, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows as CSV.

    Args:
        file: Text file, opened with `newline=""`, or standard output.
        columns: Names of the columns.
        rows: Values of each row by column; a missing one is an empty cell.
    """
    writer = csv.writer(file, lineterminator="\n")
    for row in (dict(zip(columns, columns, strict=True)), *rows):
        writer.writerow([safe_cell(row.get(column, "")) for column in columns])


def safe_cell(value: Any) -> Any:
    """Return a value for a cell: a string that a spreadsheet would evaluate gets an apostrophe in front.

    Control characters, which may begin another line, are escaped. Numbers stay as they are, even as strings.
    """
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.startswith(FORMULA) and not _is_number(text) else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True

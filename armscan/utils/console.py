"""Tables in a terminal or a log, which never break a name."""

from __future__ import annotations

import os
from collections.abc import Sequence

from rich.console import Console
from rich.measure import Measurement
from rich.table import Column, Table
from rich.text import Text

# Widths of output that is not a terminal: results choose columns to fit the first, other tables take what they need.
LOG_CHARS, WHOLE_CHARS = 160, 10_000


def wide_console(log_chars: int = LOG_CHARS) -> Console:
    """Return a console as wide as the terminal; output to a file or pipe has longer lines.

    Args:
        log_chars: Length of the longest line if the output is not a terminal and `COLUMNS` is not set. Default: 160.
    """
    console = Console()
    return console if console.is_terminal or "COLUMNS" in os.environ else Console(width=log_chars)


def print_sentence(text: str) -> None:
    """Print a text, wrapped between words on a terminal, and unwrapped in a file or pipe."""
    wide_console(WHOLE_CHARS).print(Text(text), highlight=False)


def print_table(heading: str, names: Sequence[str], columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    """Print a table with a name for each row: in a column if it fits, else in a line above its row.

    Args:
        heading: Heading of the column of names.
        names: Names of the rows.
        columns: Headings of the other columns, whose cells have one line each.
        rows: Cells of each row.
    """
    console = wide_console(WHOLE_CHARS)
    beside = _table([Column(heading), *columns], [[name, *row] for name, row in zip(names, rows, strict=True)])
    natural = Measurement.get(console, console.options.update(max_width=WHOLE_CHARS), beside)
    if natural.maximum <= console.width:
        console.print(beside)
        return
    lines = console.render_lines(_table(columns, rows), pad=False)
    n_head = len(lines) - len(rows)
    for number, line in enumerate(lines):
        if number >= n_head:
            console.print(Text(names[number - n_head], style="bold"), soft_wrap=True)
        console.print(Text.assemble(*((segment.text, segment.style or "") for segment in line)), soft_wrap=True)


def narrow_table(*columns: Column) -> Table:
    """Return an empty table without rules."""
    return Table(*columns, box=None, padding=(0, 1, 0, 0), pad_edge=False)


def _table(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> Table:
    table = narrow_table(*(Column(each.header, justify=each.justify, no_wrap=True) for each in columns))
    for row in rows:
        table.add_row(*map(Text, row))
    return table

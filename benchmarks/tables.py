"""Tables in Markdown that are printed row by row, as soon as a row is known."""

from __future__ import annotations


def print_head(*columns: str, align: str = "---") -> None:
    """Print the head of a table; `align` is the rule under all columns but the first."""
    print(f"| {' | '.join(columns).lstrip()} |")
    print_row("---", *(align for _ in columns[1:]))


def print_row(*cells: object) -> None:
    """Print a row of a table."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)

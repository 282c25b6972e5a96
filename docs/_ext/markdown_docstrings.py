"""Turn the Markdown in docstrings, headings and tables, into reStructuredText, which autodoc reads."""

import re
from collections.abc import Iterator
from itertools import groupby
from typing import Any

from sphinx.application import Sphinx

RULE = re.compile(r"^\s*\|[\s:|-]+\|$")


def cells(row: str) -> list[str]:
    """Split a row of a table, but not within backticks."""
    return [cell.strip() for cell in re.findall(r"((?:`[^`]*`|[^|`])*)\|", row.strip()[1:])]


def list_table(rows: list[str]) -> Iterator[str]:
    """Write a table's rows as a list-table."""
    indent = rows[0][: len(rows[0]) - len(rows[0].lstrip())]
    yield from ("", f"{indent}.. list-table::", f"{indent}   :header-rows: 1", "")
    for row in rows:
        if not RULE.match(row):
            for at, cell in enumerate(cells(row)):
                yield f"{indent}   {'* -' if at == 0 else '  -'} {cell}"
    yield ""


def rewrite(lines: list[str]) -> Iterator[str]:
    """Rewrite the lines of a docstring."""
    for is_table, group in groupby(lines, key=lambda line: line.lstrip().startswith("|")):
        if is_table:
            yield from list_table(list(group))
            continue
        for line in group:
            heading = re.match(r"^(\s*)#+ (.*)", line)
            if heading:
                yield from ("", f"{heading[1]}.. rubric:: {heading[2]}", "")
            else:
                yield line


def process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Rewrite a docstring in place."""
    lines[:] = list(rewrite(lines))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hook, before napoleon's."""
    app.connect("autodoc-process-docstring", process, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

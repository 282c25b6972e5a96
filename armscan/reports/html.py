"""One HTML file that needs no server, with its numbers as CSV beside it."""

from __future__ import annotations

import base64
import csv
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armscan.errors import InvalidValueError

if TYPE_CHECKING:
    from plotly import graph_objects

REPORT_FILE = "report.html"
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="generator" content="armscan">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 1160px; margin: 2rem auto; padding: 0 1rem; }}
table {{ border-collapse: collapse; display: block; overflow-x: auto; }}
.chart {{ overflow-x: auto; }}
td, th {{ border: 1px solid #ccc; padding: .2rem .6rem; text-align: left; }}
td small {{ color: #555; white-space: nowrap; }}
.results td, .results th {{ padding: .15rem .25rem; font-size: 12px; vertical-align: top; }}
.results td {{ text-align: right; white-space: nowrap; }}
.results td:first-child {{ text-align: left; white-space: normal; min-width: 7rem; }}
summary {{ cursor: pointer; font-weight: bold; margin: 1.5rem 0; }}
.matrices {{ display: flex; flex-wrap: wrap; gap: 0 2rem; }}
.matrices > div {{ max-width: 100%; }}
.matrix td {{ padding: 0; }}
.matrix td:first-child, .matrix td > div {{ padding: .2rem .35rem; }}
.videos {{ display: flex; flex-wrap: wrap; gap: 1rem; }}
.videos figure {{ margin: 0; flex: 1 1 20rem; max-width: 34rem; }}
.videos img {{ width: 100%; }}
</style><script>{script}</script></head><body><h1>{title}</h1>
{body}
</body></html>
"""
# By which a report is known.
MARK, N_MARK_CHARS = '<meta name="generator" content="armscan">', 200
# Without what leads elsewhere: a button would offer to upload a chart.
CHART_CONFIG = {"displaylogo": False, "showSendToCloud": False, "plotlyServerURL": ""}
Row = Mapping[str, Any]


class Markup(str):
    """HTML that a table shows as it is."""

    __slots__ = ()


def write_page(folder: Path, title: str, parts: Sequence[str], tables: Mapping[str, Sequence[Row]]) -> Path:
    """Write a report.

    Args:
        folder: folder that takes `report.html` and the CSV files.
        title: title of the page.
        parts: pieces of HTML, one below the other.
        tables: rows by the names of their files; each row's values by column.

    Returns:
        The HTML file.

    Raises:
        InvalidValueError: if it would replace what is no report's.
    """
    from plotly.offline import get_plotlyjs

    for name in () if _is_report(folder / REPORT_FILE) else (REPORT_FILE, *(f"{name}.csv" for name in tables)):
        if (folder / name).exists():
            raise InvalidValueError(
                f"the report would replace {folder / name}, but that is no report's: name another folder with --out"
            )
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        _write_csv(folder / f"{name}.csv", rows)
    links = "".join(f'<li><a href="{each}.csv">{each}.csv</a></li>' for each in tables)
    body = "\n".join([*parts, f"<h2>Numbers</h2><ul>{links}</ul>"])
    file = folder / REPORT_FILE
    file.write_text(page(title, body, script=get_plotlyjs()))
    return file


def page(title: str, body: str, *, script: str = "") -> str:
    """Return a page that needs no server.

    Args:
        title: title and first heading.
        body: pieces of HTML.
        script: JavaScript of the page. Default: none.
    """
    return PAGE.format(title=html.escape(title), script=script, body=body)


def _is_report(file: Path) -> bool:
    try:
        with file.open(errors="replace") as opened:
            return MARK in opened.read(N_MARK_CHARS)
    except OSError:
        return False


def table(rows: Sequence[Row]) -> str:
    """Return rows as a table, with the columns that any of them has."""
    keys = _columns(rows)
    head = "".join(f"<th>{html.escape(key)}</th>" for key in keys)
    lines = ("".join(f"<td>{_cell(row.get(key, ''))}</td>" for key in keys) for row in rows)
    return f"<table><tr>{head}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def chart(figure: graph_objects.Figure) -> str:
    """Return a chart; the page's heading says what its title would."""
    drawn = figure.update_layout(title=None).to_html(full_html=False, include_plotlyjs=False, config=CHART_CONFIG)
    return f'<div class="chart">{drawn}</div>'


def video_address(contents: bytes) -> str:
    """Return the address of an animated GIF that lies in the page itself."""
    return f"data:image/gif;base64,{base64.b64encode(contents).decode()}"


def _cell(value: Any) -> str:
    return value if isinstance(value, Markup) else html.escape(str(value))


def _write_csv(file: Path, rows: Sequence[Row]) -> None:
    with file.open("w", newline="") as opened:
        writer = csv.DictWriter(opened, _columns(rows))
        writer.writeheader()
        writer.writerows(rows)


def _columns(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(key for row in rows for key in row))

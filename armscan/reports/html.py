"""One HTML file that needs no server, with its numbers as CSV beside it."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armscan.errors import InvalidValueError
from armscan.utils.csv_file import write_csv
from armscan.utils.files import atomic_write

if TYPE_CHECKING:
    from plotly import graph_objects

REPORT_FILE = "report.html"
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="generator" content="armscan">
<meta name="viewport" content="width=device-width, initial-scale=1">{head}<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1160px; margin: 1.5rem auto; padding: 0 1rem; }}
h1, p, li, summary, figcaption, code, td {{ overflow-wrap: anywhere; }}
h2 {{ margin: 2.2rem 0 .4rem; }}
.table, .chart {{ max-width: 100%; overflow-x: auto; }}
table {{ border-collapse: collapse; margin: .5rem 0; }}
td, th {{ border-bottom: 1px solid #ddd; padding: .25rem .6rem; text-align: left; vertical-align: top; }}
th {{ border-bottom: 2px solid #999; vertical-align: bottom; overflow-wrap: normal; }}
td.word {{ overflow-wrap: normal; }}
td.number {{ text-align: right; white-space: nowrap; }}
small {{ color: #555; }}
.results td, .results th {{ text-align: right; min-width: 7.5rem; }}
.results br {{ display: none; }}
.lines td, .lines th {{ padding: .2rem .1rem; font-size: 12px; min-width: 0; }}
.lines td {{ white-space: nowrap; }}
.lines br {{ display: inline; }}
.results td small {{ white-space: normal; }}
.results td:first-child {{ text-align: left; white-space: normal; min-width: 8rem; overflow-wrap: break-word; }}
summary {{ cursor: pointer; font-weight: bold; margin: 1rem 0; }}
.matrices {{ display: flex; flex-wrap: wrap; gap: 0 2rem; }}
.matrices > div {{ max-width: 100%; }}
.matrix td {{ padding: 0; }}
.matrix td:first-child, .matrix td > div {{ padding: .2rem .35rem; overflow-wrap: normal; }}
.charts {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(min(20rem, 100%), 1fr)); gap: 0 1rem; }}
.charts > .chart {{ min-width: 0; }}
.charts .modebar {{ display: none; }}
.wide > div {{ min-width: 46rem; }}
.videos {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: 1rem; }}
.videos figure {{ margin: 0; max-width: 20rem; }}
.videos img {{ width: 100%; }}
@page {{ size: 1240px 1754px; margin: 40px; }}
@media print {{
  .table, .chart {{ overflow: visible; }}
  .chart, tr {{ break-inside: avoid; }}
  h2, h3 {{ break-after: avoid; }}
  .modebar {{ display: none !important; }}
}}
@media (max-width: 640px) {{
  body {{ margin: .5rem auto; padding: 0 .7rem; }}
  .matrix {{ font-size: 12px; }}
  .matrix th, .matrix td:first-child, .matrix td > div {{ padding: .2rem .15rem; }}
  .rows thead {{ display: none; }}
  .rows, .rows tbody, .rows tr {{ display: block; }}
  .rows tr {{ border: 1px solid #ccc; border-radius: .4rem; margin: .6rem 0; padding: .3rem .6rem; }}
  .rows tr td, .results .rows td:first-child {{
    display: flex; justify-content: space-between; gap: 1rem; border: 0; padding: .1rem 0; font-size: 14px;
    text-align: right; white-space: normal;
  }}
  .rows td::before {{ content: attr(data-label); color: #555; text-align: left; flex: none; max-width: 60%; }}
  .rows td:first-child {{ font-weight: bold; }}
  .rows tr td[data-label=""], .results .rows td[data-label=""] {{ display: block; text-align: left; }}
  .rows td[data-label=""]::before {{ display: none; }}
  .rows td:empty, .rows br, .modebar {{ display: none; }}
}}
</style><script>{script}</script></head><body><h1>{title}</h1>
{body}
</body></html>
"""
# A page with this reloads itself, and keeps its scroll position.
REFRESH = """<meta http-equiv="refresh" content="{0}"><script>
addEventListener("beforeunload", () => sessionStorage.setItem("scrolled", scrollY));
addEventListener("load", () => scrollTo(0, sessionStorage.getItem("scrolled") ?? 0));
</script>"""
# Identifies a report.
MARK, N_MARK_CHARS = '<meta name="generator" content="armscan">', 200
# Without links to other sites: a button would offer to upload a chart.
CHART_CONFIG = {"displaylogo": False, "showSendToCloud": False, "plotlyServerURL": "", "responsive": True}
FITTED = "this.querySelectorAll('.js-plotly-plot').forEach((chart) => Plotly.Plots.resize(chart))"
# A longer table is folded.
MAX_ROWS = 25
# A short text is not broken, such as the ID of a run or its status.
MAX_WORD_CHARS = 12
Row = Mapping[str, Any]


class Markup(str):
    """HTML that a table does not escape."""

    __slots__ = ()


def write_page(
    folder: Path,
    title: str,
    parts: Sequence[str],
    tables: Mapping[str, Sequence[Row]],
    *,
    refresh_s: int | None = None,
) -> Path:
    """Write a report.

    Args:
        folder: Folder that takes `report.html` and the CSV files.
        title: Title of the page.
        parts: Pieces of HTML, from top to bottom.
        tables: Rows by file name; each row's values by column.
        refresh_s: Seconds after which a browser reloads the page. Default: None, never.

    Returns:
        The HTML file.

    Raises:
        InvalidValueError: If it would replace files that are not a report's.
    """
    from plotly.offline import get_plotlyjs

    for name in () if _is_report(folder / REPORT_FILE) else (REPORT_FILE, *(f"{name}.csv" for name in tables)):
        if (folder / name).exists():
            raise InvalidValueError(
                f"the report would replace {folder / name}, but no report made it: name another folder with --out"
            )
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        with (folder / f"{name}.csv").open("w", newline="") as opened:
            write_csv(opened, _columns(rows), rows)
    links = "".join(f'<li><a href="{each}.csv">{each}.csv</a></li>' for each in tables)
    body = "\n".join([*parts, f"<h2>Numbers</h2><ul>{links}</ul>"])
    file = folder / REPORT_FILE
    text = page(title, body, script=get_plotlyjs(), refresh_s=refresh_s)
    # A browser may be reading it.
    atomic_write(file, text)
    return file


def page(title: str, body: str, *, notes: Sequence[str] = (), script: str = "", refresh_s: int | None = None) -> str:
    """Return a page that needs no server.

    Args:
        title: Title and first heading.
        body: Pieces of HTML.
        notes: Paragraphs of plain text above the body. Default: none.
        script: JavaScript of the page. Default: none.
        refresh_s: Seconds after which a browser reloads the page. Default: None, never.
    """
    head = "" if refresh_s is None else REFRESH.format(refresh_s)
    paragraphs = "".join(f"<p>{html.escape(note)}</p>" for note in notes)
    return PAGE.format(title=html.escape(title), head=head, script=script, body=paragraphs + body)


def _is_report(file: Path) -> bool:
    try:
        with file.open(errors="replace") as opened:
            return MARK in opened.read(N_MARK_CHARS)
    except OSError:
        return False


def table(rows: Sequence[Row], *, what: str = "rows", kind: str = "rows") -> str:
    """Return rows as an HTML table, with the columns that any of them has; a long one is folded.

    Args:
        rows: Values of each row by column; floats are shown with four digits.
        what: Name of the rows in the summary of a folded table. Default: rows.
        kind: `rows`: a phone shows each row as a card; `matrix`: it stays a table. Default: rows.
    """
    keys = _columns(rows)
    head = "".join(f"<th>{html.escape(key)}</th>" for key in keys)
    lines = ("".join(_cell(key, row.get(key, "")) for key in keys) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    drawn = (
        f'<div class="table"><table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )
    return drawn if len(rows) <= MAX_ROWS else folded(f"All {len(rows)} {what}", drawn)


def folded(summary: str, contents: str) -> str:
    """Return pieces of HTML that are hidden below a line that opens them."""
    # A chart drawn while hidden has no width.
    return f'<details ontoggle="{FITTED}"><summary>{html.escape(summary)}</summary>{contents}</details>'


def chart(figure: graph_objects.Figure, *, is_wide: bool = False) -> str:
    """Return a chart in the common style, without a title: the page's heading has it.

    Args:
        figure: Chart to embed.
        is_wide: Whether a phone scrolls the chart, because it cannot be narrow. Default: False.
    """
    from armscan.reports.chart_style import template

    figure.update_layout(title=None, template=template())
    drawn = figure.to_html(full_html=False, include_plotlyjs=False, config=CHART_CONFIG)
    return f'<div class="chart{" wide" if is_wide else ""}">{drawn}</div>'


def video_address(contents: bytes) -> str:
    """Return the data URL of an animated GIF."""
    return f"data:image/gif;base64,{base64.b64encode(contents).decode()}"


def _cell(key: str, value: Any) -> str:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    shown = f"{value:.4g}" if isinstance(value, float) else str(value)
    contents = value if isinstance(value, Markup) else html.escape(shown)
    label = f' data-label="{html.escape(key)}"'
    is_word = len(shown) <= MAX_WORD_CHARS and not isinstance(value, Markup)
    kind = " class=number" if is_number else " class=word" if is_word else ""
    # An empty cell is not shown on a phone.
    return f"<td{kind}{label}>{f'<div>{contents}</div>' if contents else ''}</td>"


def _columns(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(key for row in rows for key in row))

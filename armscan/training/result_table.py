"""The table of results, with the same figures and names everywhere.

Every figure is over all episodes, failed ones included, with its 95 % interval, and its name says which statistic it
is. The on-plane rate comes first, because the reward also accepts planes far from the labelled one.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from armscan.stats.bootstrap import Estimate
from armscan.training.metric_display import LEADING, OLDER, QUANTITIES, Quantity, interval_text
from armscan.training.metrics import MetricEstimates
from armscan.utils.text import MISSING, counted, formatted, markdown_table

# Maximum number of results that are columns side by side; with more, each is a line.
MAX_ABREAST = 6
# Characters between two columns.
PADDING_CHARS = 2
HOW = (
    "95 % intervals resample seeds, subjects and episodes. If all episodes of a rate are equal, its interval is "
    "Wilson's, which takes episodes as independent. Means include failed episodes; the IQM is the mean of the middle "
    "half of all episodes. On plane: share of episodes whose last plane is this close to the labelled one. Success: "
    "share of episodes whose last plane the reward accepts; it may lie far from the labelled one."
)
HOW_WITHOUT_EPISODES = "95 % intervals are Student's, for other seeds and subjects; none if all values are equal."
COUNTS = {"episodes": "n_episodes", "started solved": "n_started_solved", "seeds": "n_seeds", "volumes": "n_volumes"}
# A heading, and a cell for each line.
Column = tuple[str, Sequence[str]]


@dataclass(frozen=True)
class ResultTable:
    """Results side by side.

    Args:
        results: Metrics of each result, by its name, such as `random, test`; the on-plane limits are those of the
            first that has any.
        facts: Further columns, shown first: a string for each result, by heading.
        headline: Result in a few sentences, shown above the table on pages and below it in a terminal; see `headline`.
            Default: none.
    """

    results: Mapping[str, MetricEstimates]
    facts: Mapping[str, Sequence[str]] = field(default_factory=dict)
    headline: str = ""

    @property
    def quantities(self) -> list[Quantity]:
        """The columns for which a result has a figure; if there are none, all metrics."""
        known = {
            name for each in self.results.values() for name, estimate in each.estimates.items() if is_known(estimate)
        }
        limits = next((each.on_plane for each in self.results.values() if each.on_plane), ())
        older = [column for column, better in OLDER.items() if better not in known]
        columns = [*(Quantity(each.metric, each.title, "{:.1%}") for each in limits), *QUANTITIES, *older]
        shown = [column for column in columns if column.metric in known]
        return shown or [Quantity(name, name.replace("_", " "), "{:.3g}") for name in sorted(known)]

    @property
    def how(self) -> str:
        """How the figures are computed; empty without figures."""
        has_episodes = any(each.n_episodes for each in self.results.values())
        return (HOW if has_episodes else HOW_WITHOUT_EPISODES) if self.quantities else ""

    def show(self, width: int) -> list[Table | Text]:
        """Return the table for a terminal: a few results side by side, many as lines.

        Args:
            width: Width of the terminal, in characters; columns that do not fit are left out, and named.
        """
        if not self.facts and len(self.results) <= MAX_ABREAST:
            return [*self._abreast(width)]
        return self.lines(width)

    def html(self) -> str:
        """Return the table as HTML: a column for each of a few results, a line for each of many."""
        results, is_few = self.results.values(), len(self.results) <= MAX_ABREAST
        names = [*map(html.escape, self.results)]
        facts = [[html.escape(heading), *map(html.escape, values)] for heading, values in self.facts.items()]
        if facts and not is_few:
            told = [", ".join(filter(None, each)) for each in zip(*(values for _, *values in facts), strict=True)]
            names = [f"{name}<br> <small>{each}</small>" for name, each in zip(names, told, strict=True)]
        columns = [
            ["", *names],
            *(facts if is_few else ()),
            *([html.escape(each.title), *(_html_cell(result, each) for result in results)] for each in self.quantities),
            *([title, *(_count(result, name) for result in results)] for title, name in COUNTS.items()),
        ]
        labels, *lines = columns if is_few else zip(*columns, strict=True)
        head = "".join(f"<th>{label}</th>" for label in labels)
        body = "".join(f"<tr>{''.join(map(_labelled, labels, line))}</tr>" for line in lines)
        drawn = f'<table class="rows"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
        kind = "results" if is_few else "results lines"
        said = f"<p><strong>{html.escape(self.headline)}</strong></p>" if self.headline else ""
        return f'{said}<div class="{kind}"><div class="table">{drawn}</div><p><small>{self.how}</small></p></div>'

    def markdown(self) -> str:
        """Return the table in Markdown, a column for each result."""
        rows = [[heading, *values] for heading, values in self.facts.items()]
        for column in self.quantities:
            cells = (" ".join(_cell(each, column, "({})")) for each in self.results.values())
            rows.append([column.title, *cells])
        for title, count in COUNTS.items():
            rows.append([title, *(_count(each, count) for each in self.results.values())])
        table = markdown_table(["with 95 % intervals", *self.results], rows)
        return f"**{self.headline}**\n\n{table}" if self.headline else table

    def _abreast(self, width: int) -> list[Table]:
        """Return tables with a column for each result, as many beside each other as fit."""
        first = [column.heading for column in self.quantities] + list(COUNTS)
        columns = []
        for name, result in self.results.items():
            cells = ["\n".join(_cell(result, column)) for column in self.quantities]
            cells += [_count(result, count) for count in COUNTS.values()]
            columns.append((name.replace(", ", ",\n"), cells))
        tables, left = [], columns
        while left:
            fitting = _fitting(width, [("", first)], left)
            tables.append(_table([("", first)], left[:fitting]))
            left = left[fitting:]
        return tables

    def lines(self, width: int) -> list[Table | Text]:
        """Return a table with a line for each result and the columns that fit, and the names of the others."""
        names = [("", list(self.results)), *((heading, list(values)) for heading, values in self.facts.items())]
        columns: dict[str, Column] = {}
        for column in self.quantities:
            cells = ["\n".join(_cell(each, column)) for each in self.results.values()]
            columns[column.metric] = column.heading, cells
        for title, count in COUNTS.items():
            columns[count] = title.replace(" ", "\n"), [_count(each, count) for each in self.results.values()]
        # Leading columns first; sorting keeps the order of the others.
        leading = (next(iter(columns)), *LEADING)
        by_need = sorted(columns, key=lambda name: leading.index(name) if name in leading else len(leading))
        wanted = [columns[name] for name in by_need]
        legend: list[Text] = []
        if self.facts and _fitting(width, names, wanted) < min(len(leading), len(wanted)):
            # On lines of their own, because the figures need the width.
            facts = zip(self.results, *self.facts.values(), strict=True)
            legend = [Text(f"{name}: {', '.join(filter(None, told))}") for name, *told in facts if any(told)]
            names = names[:1]
        fitting = by_need[: _fitting(width, names, wanted)]
        shown = _table(names, [columns[name] for name in columns if name in fitting])
        tables: list[Table | Text] = [shown, *legend]
        if left := [columns[name][0].replace("\n", " ") for name in columns if name not in fitting]:
            tables.append(Text(f"not shown at {width} characters: {'; '.join(left)}"))
        return tables


def with_baselines(
    results: Mapping[str, MetricEstimates], baselines: Mapping[str, Mapping[str, MetricEstimates]]
) -> dict[str, MetricEstimates]:
    """Return results with the baselines below them.

    Args:
        results: Metrics of each result, by its name.
        baselines: Metrics of each result's baselines, by its name and theirs. Results with the same volumes and rules
            share baselines, which are shown once; others carry the names of their results.
    """
    of_figures: dict[tuple[str, str], list[str]] = {}
    for result, ours in baselines.items():
        for name, figures in ours.items():
            # Compares what is shown: times, which always differ, are not.
            shown = [figures.estimate(column.metric) for column in ResultTable({name: figures}).quantities]
            of_figures.setdefault((name, repr(shown)), []).append(result)
    below = {}
    for (name, _), which in of_figures.items():
        of_which = f" of {', '.join(which)}" if len(which) < len(results) else ""
        below[f"{name}{of_which}"] = baselines[which[0]][name]
    return {**results, **below}


def is_known(estimate: Estimate) -> bool:
    """Return whether a figure was measured."""
    return not math.isnan(estimate.value)


def _cell(result: MetricEstimates, column: Quantity, around: str = "{}") -> tuple[str, str]:
    """Return a value and its interval as strings."""
    estimate = result.estimate(column.metric)
    if not is_known(estimate):
        return MISSING, ""
    interval = interval_text(estimate, column.form)
    return formatted(column.form, estimate.value), interval and around.format(interval)


def _count(result: MetricEstimates, name: str) -> str:
    count = getattr(result, name)
    # Metrics of a validation do not have the number of its volumes, and those of a task without episodes none of these.
    has_count = count if name in ("n_seeds", "n_volumes") else result.n_episodes
    if name == "n_volumes" and 0 < result.n_subjects < count:
        return f"{count} ({counted(result.n_subjects, 'subject')})"
    return str(count) if has_count else MISSING


def _html_cell(result: MetricEstimates, column: Quantity) -> str:
    value, interval = _cell(result, column)
    return f"{value}<br> <small>{interval}</small>"


def _labelled(label: str, cell: str) -> str:
    return f'<td data-label="{label}"><div>{cell}</div></td>'


def _width(column: Column) -> int:
    heading, cells = column
    return max(len(line) for text in (heading, *cells) for line in text.split("\n")) + PADDING_CHARS


def _fitting(width: int, names: Sequence[Column], columns: Sequence[Column]) -> int:
    """Return how many of the columns fit beside the names, at least one."""
    taken = sum(map(_width, names))
    for number, column in enumerate(columns):
        taken += _width(column)
        if taken > width:
            return max(1, number)
    return len(columns)


def _table(names: Sequence[Column], columns: Sequence[Column]) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    for heading, _ in names:
        table.add_column(Text(heading), overflow="fold")
    for heading, _ in columns:
        table.add_column(Text(heading, justify="right"), justify="right", no_wrap=True)
    for line in zip(*(cells for _, cells in (*names, *columns)), strict=True):
        table.add_row(*map(Text, line))
    return table

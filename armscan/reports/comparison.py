"""The comparison of any runs: learning curves, final figures, probability of improvement, and videos side by side."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from armscan.reports.charts import MANY, Curves, colours, final_chart, learning_curves
from armscan.reports.csv_tables import all_numbers
from armscan.reports.curves import AXES, curve_of
from armscan.reports.groups import Group, differing_rules
from armscan.reports.html import Markup, chart, folded, table, write_page
from armscan.reports.load import TrackedTraining, validation_titles
from armscan.reports.notes import notes_on
from armscan.reports.significance import (
    COMPARED_BY,
    Pair,
    baseline_metrics,
    can_differ,
    compare_groups,
    complement,
    evaluations_by_seed,
    final_metrics,
    have_same_volumes,
)
from armscan.reports.videos import videos
from armscan.stats.bootstrap import Estimate
from armscan.training import MetricEstimates, ResultTable
from armscan.training.baselines import RANDOM
from armscan.training.headline import headline
from armscan.training.metric_display import title_of
from armscan.training.result_table import with_baselines
from armscan.utils.text import MISSING, counted

HOW_CURVES = (
    "On the validation volumes, after each epoch. Thick: the mean of the seeds of a group. Band: its 95 % interval "
    "for other seeds (Student's), if there are three or more. Thin: each seed. A training that ran to its end before "
    "others of its group is carried on with its last value. Where one was cut off, is still running, or has a "
    "metric that became NaN, the curve of its group ends. Seconds are wall time of training and validation, on the "
    "machine of the run."
)
MEANS_ALONE = "Of so many groups only the means are drawn: curves.csv has the bands, seed_curves.csv the seeds."
HOW_FINAL = (
    "The final evaluation, with the weights of the best epoch, on test volumes that nothing before has used, "
    "over all episodes of all seeds, beside the baselines. In the chart diamonds are these figures, dots the seeds."
)
HOW_BETTER = (
    "How likely a training of the row's group is better than one of the column's group: the share of pairs of seeds, "
    "ties counting half, averaged over the test volumes "
    '(<a href="https://arxiv.org/abs/2108.13264">Agarwal et al. 2021</a>), with a 95 % interval for other seeds '
    '(<a href="https://doi.org/10.1002/sim.2324">Newcombe 2006</a>; with many groups, shown under the pointer). 0.5 is '
    "no difference; bold: the interval excludes it. Columns are numbered like the rows."
)


# With more groups, the pairwise comparison is folded.
MANY_PAIRS = 12
NO_BEST = "No best group: the groups were judged {}."
# With more groups, nobody can tell the bands apart.
MAX_DETAILED = 24


def write_comparison(groups: Sequence[Group], left_out: Sequence[TrackedTraining], title: str, folder: Path) -> Path:
    """Write the report.

    Args:
        groups: Groups to compare.
        left_out: Trainings that repeat another one.
        title: Title of the page.
        folder: Folder that takes `report.html` and the CSV files.

    Returns:
        The HTML file.
    """
    metrics = _metrics(groups)
    curves = {
        (metric, axis, number): curve
        for metric in metrics
        for axis in AXES
        for number, group in enumerate(groups)
        if (curve := curve_of(group, metric, axis))
    }
    reached = [final_metrics(group) for group in groups]
    pairs = compare_groups(groups)
    final = groups_table(groups, reached)
    labels = {group.label for group in groups}
    baselines = {name: each for name, each in final.results.items() if name not in labels}
    tables = all_numbers(groups, curves, reached, pairs, baselines)
    titles = validation_titles(metrics)
    has_other_volumes = any(each.probability is None for each in pairs["on_plane_rate"])
    parts = [
        f"<p><strong>{html.escape(final.headline)}</strong></p>" if final.headline else "",
        _summary(groups),
        notes_on(groups, left_out, curves, reached, has_other_volumes=has_other_volumes),
        *_learning(groups, curves),
        *_final(groups, reached, replace(final, headline=""), baselines),
        *_better(groups, pairs),
        videos(groups),
        *_of_the_training(groups, curves, [metric for metric in metrics if metric not in titles]),
        "<h2>Runs</h2>",
        table(tables["runs"], what="runs"),
    ]
    return write_page(folder, title, parts, tables)


def _metrics(groups: Sequence[Group]) -> list[str]:
    """Return the names of the metrics that can be drawn, those of the validation first."""
    names = {name for group in groups for training in group.trainings for name in training.series}
    titles = validation_titles(names)
    return [*titles, *sorted(names - titles.keys())]


def _summary(groups: Sequence[Group]) -> str:
    n_trainings = sum(len(group.trainings) for group in groups)
    by = "the seed and the fold" if any(group.n_folds for group in groups) else "the seed"
    rows = [
        {
            "group": Markup(f'<span style="color: {colour}">●</span> {html.escape(group.title)}'),
            "runs, with their seeds": ", ".join(f"{each.id} ({_seed_and_fold(each)})" for each in group.trainings),
            "environment steps": _span([training.env_steps for training in group.trainings]),
            "training, s": _span([training.wall_s for training in group.trainings]),
        }
        for group, colour in zip(groups, colours(len(groups)), strict=True)
    ]
    runs = f"{counted(n_trainings, 'run')} in {counted(len(groups), 'group')}"
    others = {
        "their volumes": any(not group.has_same_volumes for group in groups),
        "the code of own classes": any(group.mixed_modules for group in groups),
        "armscan's version": any(len(group.commits) > 1 for group in groups),
    }
    but = " and ".join(name for name, differs in others.items() if differs)
    same = f", except for {but}" if but else ""
    return f"<p>{runs}: those of a group differ by nothing but {by}{same}.</p>{table(rows, what='groups')}"


def _seed_and_fold(training: TrackedTraining) -> str:
    """Return the seed of a training, and the fold that it was tested on."""
    seed = training.seed or MISSING
    return seed if training.fold is None else f"{seed}, fold {training.fold}"


def _learning(groups: Sequence[Group], curves: Curves) -> Iterator[str]:
    yield "<h2>Learning curves</h2>"
    titles = validation_titles(metric for metric, *_ in curves)
    if titles:
        is_detailed = len(groups) <= MAX_DETAILED
        how = HOW_CURVES if is_detailed else f"{HOW_CURVES} {MEANS_ALONE}"
        yield f"<p>{how}</p>{chart(learning_curves(groups, curves, titles, is_detailed=is_detailed))}"
    else:
        yield "<p>None of these runs has been validated: nothing is trained, or nothing validated yet.</p>"


def _of_the_training(groups: Sequence[Group], curves: Curves, metrics: Sequence[str]) -> Iterator[str]:
    if metrics:
        titles = {name: _title_of_training(name) for name in metrics}
        drawn = chart(learning_curves(groups, curves, titles, is_detailed=len(groups) <= MANY))
        yield folded("Metrics of the training itself: losses, returns, speed", drawn)


def _title_of_training(metric: str) -> str:
    return metric.partition("/")[2].replace("_per_s", ", 1/s").replace("_", " ").replace("env ", "environment ")


def _final(
    groups: Sequence[Group],
    reached: Sequence[MetricEstimates | None],
    final: ResultTable,
    baselines: Mapping[str, MetricEstimates],
) -> Iterator[str]:
    yield "<h2>On the test volumes</h2>"
    if not any(reached):
        yield "<p>None of these runs has kept a final evaluation.</p>"
        return
    drawn = chart(final_chart(groups, reached, baselines), is_wide=True)
    yield f"<p>{HOW_FINAL}</p>{final.html()}{drawn}"


def groups_table(groups: Sequence[Group], reached: Sequence[MetricEstimates | None]) -> ResultTable:
    """Return the table of the groups' results, and of the baselines."""
    nothing = MetricEstimates.of_metrics({})
    metrics = {group.label: each or nothing for group, each in zip(groups, reached, strict=True)}
    evaluated = [group for group in groups if evaluations_by_seed(group)]
    labels = [group.label for group in evaluated]
    baselines = dict(zip(labels, baseline_metrics(evaluated), strict=True))
    randoms = {label: each[RANDOM] for label, each in baselines.items() if RANDOM in each}
    # The best of several tasks is the easiest.
    differing = ["in different tasks"] if differing_rules(evaluated) else []
    differing += [] if have_same_volumes(evaluated) else ["on different test volumes"]
    best = headline(metrics, randoms) if not differing else NO_BEST.format(" and ".join(differing))
    return ResultTable(with_baselines(metrics, baselines), headline=best)


def _better(groups: Sequence[Group], pairs: Mapping[str, Sequence[Pair]]) -> Iterator[str]:
    if len(groups) < 2:
        return
    yield "<h2>Which is likely to be better</h2>"
    if not any(pairs.values()):
        yield "<p>Fewer than two groups have a final evaluation.</p>"
        return
    matrices = []
    for metric, of_metric in pairs.items():
        heading = f"By {'on-plane rate' if metric == 'on_plane_rate' else title_of(metric)}: "
        heading += f"{'higher' if COMPARED_BY[metric] else 'lower'} is better"
        matrices.append(f"<div><h3>{heading}</h3>{_matrix(groups, of_metric)}</div>")
    n_seeds = [len(evaluations_by_seed(group)) for group in groups]
    # With very few seeds, pairs are never bold.
    n_pairs = max(
        sum(each.probability is not None and can_differ(n_seeds[each.ours], n_seeds[each.theirs]) for each in of_metric)
        for of_metric in pairs.values()
    )
    by_chance = (
        f" If all groups were alike, at most {0.05 * n_pairs:.2g} of {n_pairs} pairs would be bold by chance, on "
        "average."
    )
    drawn = f'<p>{HOW_BETTER}{by_chance * (n_pairs > 1)}</p><div class="matrices">{"".join(matrices)}</div>'
    yield drawn if len(groups) <= MANY_PAIRS else folded(f"Each of {len(groups)} groups against each other", drawn)


def _matrix(groups: Sequence[Group], pairs: Sequence[Pair]) -> str:
    """Return a table of the groups against each other; the columns are numbered as the rows are."""
    cells: dict[tuple[int, int], Markup] = {}
    is_few = len(groups) <= MANY
    for pair in pairs:
        theirs = complement(pair.probability) if pair.probability else None
        cells[pair.ours, pair.theirs] = _cell(pair.probability, is_few=is_few)
        cells[pair.theirs, pair.ours] = _cell(theirs, is_few=is_few)
    numbers = range(len(groups))
    rows = [
        {"": groups[row].label}
        | {
            f"{'than ' if is_few else ''}{column + 1}": cells.get((row, column), Markup("<div>–</div>"))
            for column in numbers
        }
        for row in numbers
    ]
    return table(rows, what="groups", kind="matrix")


def _cell(probability: Estimate | None, *, is_few: bool) -> Markup:
    """Return a cell of the matrix, in bold if the interval leaves out 0.5."""
    if probability is None:
        return Markup("<div><small>other volumes</small></div>")
    value, low, high = probability
    # From red through white to green.
    strength = abs(value - 0.5)
    shade = f"rgba({'44, 160, 44' if value >= 0.5 else '214, 39, 40'}, {strength:.2f})"
    is_bold = low > 0.5 or high < 0.5
    # A third digit where an end that excludes 0.5 would be rounded to it.
    n_digits = 3 if is_bold and "0.50" in (f"{low:.2f}", f"{high:.2f}") else 2
    ends = "one seed" if math.isnan(low) else f"{low:.{n_digits}f} to {high:.{n_digits}f}"
    shown = f"<b>{value:.2f}</b>" if is_bold else f"{value:.2f}"
    below = f"<br><small>{ends}</small>" if is_few else ""
    return Markup(f'<div style="background: {shade}" title="{ends}">{shown}{below}</div>')


def _span(values: Sequence[float]) -> str:
    """Return the mean of the known values, with the lowest and the highest if they differ."""
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return MISSING
    low, high, mean = min(known), max(known), sum(known) / len(known)
    return f"{mean:,.0f}" + (f" ({low:,.0f}–{high:,.0f})" if high > low else "")

"""Print tables of results, and where to look for more, in the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from rich.text import Text

from armscan.config.command_hints import STARTED_IN, armscan_command
from armscan.experiment.job import INTERRUPTED, JobOutcome
from armscan.experiment.results import TITLES
from armscan.training import TEST, MetricEstimates, ResultTable
from armscan.training.baselines import RANDOM
from armscan.training.headline import headline
from armscan.training.result_table import with_baselines
from armscan.utils.console import print_sentence, wide_console
from armscan.utils.run_files import ID_CHARS


def print_result_table(
    title: str, table: ResultTable, notes: Iterable[str] = (), *, how: bool = True, of: str = ""
) -> None:
    """Print a table of results that fits the terminal.

    Args:
        title: Line above the table.
        table: Table to print.
        notes: Notes below the table, one sentence each. Default: none.
        how: Whether to explain how its figures are computed. Default: True.
        of: What the result is of, where a command prints several. Default: nothing.
    """
    console = wide_console()
    console.print(Text(title, style="italic"))
    for part in table.show(console.width):
        console.print(part)
    if how and table.how:
        console.print(Text(table.how, style="dim"))
    for note in notes:
        print_sentence(f"note: {note}")
    if table.headline:
        print_sentence(f"result{of and f' ({of})'}: {table.headline}")


def print_jobs(outcomes: Mapping[str, JobOutcome], run_ids: Mapping[str, str], *, have_same_task: bool) -> ResultTable:
    """Print the table of a grid's jobs, and return it.

    Args:
        outcomes: Outcome of each job, by its number.
        run_ids: MLflow run ID of each job that started a run, by its number.
        have_same_task: Whether all jobs have the same task and test volumes; otherwise the best of them is the easiest,
            and the table has no headline.
    """
    table = jobs_table(outcomes, run_ids, have_same_task=have_same_task)
    print_result_table(f"jobs ({TEST})", table)
    return table


def jobs_table(outcomes: Mapping[str, JobOutcome], run_ids: Mapping[str, str], *, have_same_task: bool) -> ResultTable:
    """Return the table of a grid's jobs, with the baselines below them; see `print_jobs`."""
    figures = {
        number: {name: MetricEstimates.of_metrics(metrics) for name, metrics in outcome.metrics.items()}
        for number, outcome in outcomes.items()
    }
    tested = {number: each.pop(TEST, MetricEstimates.of_metrics({})) for number, each in figures.items()}
    baselines = {
        number: {name: of_name for name, of_name in each.items() if name not in TITLES}
        for number, each in figures.items()
        if each
    }
    results = with_baselines(tested, baselines)
    ended = {None: "done", INTERRUPTED: INTERRUPTED}
    facts = {
        "run": [run_ids.get(number, "-")[:ID_CHARS] for number in outcomes],
        "overrides": [outcome.varied for outcome in outcomes.values()],
        "outcome": [ended.get(outcome.failure, "failed") for outcome in outcomes.values()],
    }
    n_baselines = len(results) - len(outcomes)
    names = {number: f"{number} ({outcome.varied})" for number, outcome in outcomes.items()}
    randoms = {names[number]: each[RANDOM] for number, each in baselines.items() if RANDOM in each}
    return ResultTable(
        results,
        {heading: [*values, *[""] * n_baselines] for heading, values in facts.items()},
        headline({names[number]: each for number, each in tested.items()}, randoms) if have_same_task else "",
    )


def print_where_to_look(
    folder: Path, tracking_uri: str, *, storage: str | None = None, files: Sequence[str] = ("",)
) -> None:
    """Print where the results lie, and the command that opens the UI over all runs.

    Args:
        folder: Folder of the run or grid.
        tracking_uri: MLflow tracking URI.
        storage: Optuna storage of the study. Default: None, no study.
        files: Files worth looking at, relative to the folder. Default: the folder itself.
    """
    for file in files:
        print(f"look at   {path_to_type(folder / file)}")
    print(f"all runs  {armscan_command('ui', tracking=tracking_uri, storage=storage)}")


def path_to_type(path: Path) -> Path:
    """Return a path as one would type it in the folder that the command was started in."""
    here = Path.cwd()
    if not path.is_relative_to(here):
        return path
    # A resumed run has changed to another folder.
    return path.relative_to(here) if here == STARTED_IN else path.absolute()

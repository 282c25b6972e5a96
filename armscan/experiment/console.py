"""Print tables of results, and where to look for more, in the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.text import Text

from armscan.config.command_hints import STARTED_IN, armscan_command
from armscan.training import ResultTable
from armscan.utils.console import print_sentence, wide_console


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

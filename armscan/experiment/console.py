"""Tables of results, and where to look for more, in the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from armscan.config.command_hints import armscan_command
from armscan.experiment.job import INTERRUPTED, JobOutcome
from armscan.training import TEST, Evaluation

# Of a run's id, where there is no room for all of it.
ID_CHARS = 8
RESULT_ROWS = (
    ("success rate", "success_rate", "{:.1%}"),
    ("mean steps", "mean_steps", "{:.2f}"),
    ("mean final reward", "mean_final_reward", "{:.3f}"),
    ("mean distance to the plane", "mean_distance_mm", "{:.1f} mm"),
    ("mean angle to the plane", "mean_distance_deg", "{:.1f}°"),
    ("mean Dice with its slice", "mean_dice", "{:.2f}"),
    ("episodes", "episodes", "{:.0f}"),
    ("... of which started solved", "episodes_started_solved", "{:.0f}"),
    ("success rate of the others", "success_rate_not_started_solved", "{:.1%}"),
    ("mean steps of the others", "mean_steps_not_started_solved", "{:.2f}"),
)


def print_results(title: str, evaluations: Mapping[str, Evaluation]) -> None:
    """Print a table with a column for each evaluation, by the name of its volumes."""
    figures = {name: evaluation.metrics() for name, evaluation in evaluations.items()}
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for name in figures:
        table.add_column(name, justify="right")
    for text, key, form in RESULT_ROWS:
        table.add_row(text, *("-" if f[key] != f[key] else form.format(f[key]) for f in figures.values()))
    Console().print(table)


def print_jobs(outcomes: Mapping[str, JobOutcome], run_ids: Mapping[str, str]) -> None:
    """Print the table of a multirun's jobs: outcomes, and MLflow run IDs, by the jobs' numbers."""
    table = Table(title=f"jobs ({TEST})", title_justify="left")
    for heading in ("job", "run", "overrides", "outcome", "success rate", "mean steps"):
        table.add_column(heading)
    for number, outcome in outcomes.items():
        judged = outcome.metrics.get(TEST, {})
        figures = [f"{judged['success_rate']:.1%}", f"{judged['mean_steps']:.2f}"] if judged else ["-", "-"]
        ended = {None: "done", INTERRUPTED: INTERRUPTED}.get(outcome.failure, "failed")
        table.add_row(number, run_ids.get(number, "-")[:ID_CHARS], outcome.varied, ended, *figures)
    Console().print(table)


def print_where_to_look(
    folder: Path, tracking_uri: str, *, storage: str | None = None, files: Sequence[str] = ("",)
) -> None:
    """Print where the results lie, and the command that opens the UI over all runs.

    Args:
        folder: folder of the run or multirun.
        tracking_uri: MLflow tracking URI.
        storage: Optuna storage of the study; default: None, no study.
        files: what is worth looking at in the folder; the folder itself where none is named.
    """
    for file in files:
        print(f"look at   {from_here(folder / file)}")
    print(f"all runs  {armscan_command('ui', tracking=tracking_uri, storage=storage)}")


def from_here(path: Path) -> Path:
    """Return a path as one would type it in the current folder."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path

"""Tables of a grid: of its jobs, and over all folds of a cross-validation, kept in its folder and its run."""

from __future__ import annotations

import contextlib
import html
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from armscan.config.defaults import FOLD, FOLDS
from armscan.config.error_messages import one_line_message
from armscan.config.own_code import mixed_modules
from armscan.config.task import task_differences
from armscan.errors import ArmscanError, TrackingError, few
from armscan.experiment.console import print_result_table
from armscan.experiment.job import INTERRUPTED, Grid, JobOutcome
from armscan.experiment.results import TITLES, few_subjects
from armscan.launch.folds_table import AGENT_ON_ALL_FOLDS, ALL_FOLDS, folds_table
from armscan.launch.grid_jobs import jobs_of
from armscan.reports.html import page
from armscan.tracking.git import CODE_TAGS
from armscan.tracking.outbox import now_ms
from armscan.tracking.tags import FOLDER_TAG, JOB_TAG, OWN_CODE_TAG
from armscan.tracking.uploader import set_description
from armscan.training import TEST, MetricEstimates, ResultTable
from armscan.training.baselines import RANDOM
from armscan.training.episode_results import TEST_METRICS, metric_prefix
from armscan.training.headline import ABOVE_RANDOM, headline
from armscan.training.result_table import with_baselines
from armscan.utils.files import atomic_write
from armscan.utils.run_files import ID_CHARS, RESULTS_PAGE
from armscan.utils.text import MISSING, counted
from armscan.volumes.dataset import subjects_in

# Parameters by which tasks differ that a note names.
N_NAMED = 3

if TYPE_CHECKING:
    from mlflow.entities import Run

    from armscan.tracking import TrackingStore


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
        "run": [run_ids.get(number, MISSING)[:ID_CHARS] for number in outcomes],
        "overrides": [outcome.varied for outcome in outcomes.values()],
        "outcome": [ended.get(outcome.failure, "failed") for outcome in outcomes.values()],
    }
    n_baselines = len(results) - len(outcomes)
    names = {
        number: f"{number} ({outcome.varied})" if outcome.varied else f"job {number}"
        for number, outcome in outcomes.items()
    }
    randoms = {names[number]: each[RANDOM] for number, each in baselines.items() if RANDOM in each}
    return ResultTable(
        results,
        {heading: [*values, *[""] * n_baselines] for heading, values in facts.items()},
        headline({names[number]: each for number, each in tested.items()}, randoms) if have_same_task else "",
    )


def keep_tables(
    table: ResultTable,
    folder: Path,
    grid: Grid,
    outcomes: Mapping[str, JobOutcome],
    runs: Sequence[Run],
    store: TrackingStore,
) -> None:
    """Save the table of the jobs, or print and save the one over all folds; only print an error: the grid has ended."""
    from mlflow.exceptions import MlflowException

    try:
        planned = jobs_of(grid.overrides)[1] if grid.has_known_jobs else None
        n_jobs = len(outcomes) if planned is None else len(planned)
        n_finished = sum(outcome.failure is None for outcome in outcomes.values())
        finished = [run for run in runs if outcomes[run.data.tags[JOB_TAG]].failure is None]
        mixed = mixed_modules(run.data.tags.get(OWN_CODE_TAG) for run in finished)
        on_code = [f"the jobs used different versions of {few(mixed)} (tag {OWN_CODE_TAG})"] if mixed else []
        if len({tuple(run.data.tags.get(tag) for tag in CODE_TAGS) for run in finished}) > 1:
            on_code.append(f"the jobs used different versions of armscan's code (tags {', '.join(CODE_TAGS)})")
        if others := _task_differences(finished):
            on_code.append(
                f"the jobs have different tasks ({few(others, N_NAMED)}), so the table names none as the best"
            )
        if planned is not None and (pooled := _pooled_folds(grid, outcomes, finished, planned)) is not None:
            of_folds, notes = pooled[0], [*pooled[1], *on_code]
            print_result_table(f"{next(iter(of_folds.results)).split(', ')[1]} (test)", of_folds, notes)
            keep_folds_table(of_folds, table, folder, store, grid.run_id, notes)
        else:
            missing = [f"of {n_jobs} jobs, {n_jobs - n_finished} without a result"] if n_finished < n_jobs else []
            notes = [*missing, *on_code]
            for note in notes:
                print(f"note: {note}")
            body = f"<p><code>{html.escape(' '.join(grid.overrides))}</code></p>{table.html()}"
            text = page(f"Grid of {counted(n_jobs, 'job')}", body, notes=notes)
            _keep_page(folder, text, "\n\n".join([*notes, table.markdown()]), store, grid.run_id)
    except (TrackingError, MlflowException, OSError) as error:
        print(f"the tables of the grid are not kept: {one_line_message(error) or error}", file=sys.stderr)


def keep_folds_table(
    table: ResultTable, jobs: ResultTable, folder: Path, store: TrackingStore, run_id: str, notes: Sequence[str]
) -> None:
    """Save the tables of all folds and of the jobs in the grid's folder, and with the figures in the grid's run.

    Args:
        table: Table of all folds.
        jobs: Table of the jobs, shown below.
        folder: Folder of the grid.
        store: Store of the grid's run.
        run_id: MLflow run ID of the grid.
        notes: Notes on the table, such as missing folds.

    Raises:
        TrackingError: If the store is unavailable.
    """
    from mlflow.entities import Metric

    text = page("all folds (test)", f"{table.html()}<h2>Jobs</h2>{jobs.html()}", notes=notes)
    _keep_page(folder, text, "\n\n".join([*notes, table.markdown()]), store, run_id)
    time_ms = now_ms()
    # If runs also differ in other settings, or folds are missing, only the page has their figures.
    groups = {
        title: TEST_METRICS if title == AGENT_ON_ALL_FOLDS else metric_prefix(title.removesuffix(ALL_FOLDS))
        for title in table.results
        if title.endswith(ALL_FOLDS)
    }
    shown = [*(column.metric for column in table.quantities), ABOVE_RANDOM]
    metrics = [
        Metric(f"{group}/{name}", value, time_ms, 0)
        for title, group in groups.items()
        for name, value in table.results[title].shown_metrics(shown).items()
        if math.isfinite(value)
    ]
    store.log_batch(run_id, metrics=metrics)


def _keep_page(folder: Path, text: str, description: str, store: TrackingStore, run_id: str) -> None:
    file = folder / RESULTS_PAGE
    atomic_write(file, text)
    store.log_artifact(run_id, str(file))
    set_description(store, run_id, description)


def _task_differences(runs: Sequence[Run]) -> list[str]:
    """Return the parameters by which the tasks of jobs differ, beside their folds."""
    return task_differences({key: value for key, value in run.data.params.items() if key != FOLD} for run in runs)


def _n_folds(finished: Sequence[Run], n_planned: int) -> int:
    """Return the number of folds of a cross-validation, of which a grid may have planned some alone."""
    params = finished[0].data.params if finished else {}
    folds, n_volumes = params.get(FOLDS, ""), params.get("data.n_volumes", "")
    if folds.isdecimal():
        return int(folds)
    # The folder of the volumes may be gone, or have changed.
    with contextlib.suppress(ArmscanError, KeyError):
        return len(set(subjects_in(params["data.path"], int(n_volumes) if n_volumes.isdecimal() else None)))
    return n_planned


def _pooled_folds(
    grid: Grid,
    outcomes: Mapping[str, JobOutcome],
    finished: Sequence[Run],
    jobs: Sequence[Sequence[str]],
) -> tuple[ResultTable, list[str]] | None:
    """Return one table over all folds of a cross-validation, and notes on it; None of another grid."""
    if not any(override.startswith(f"{FOLD}=") for override in grid.overrides):
        return None
    planned = [dict(override.partition("=")[::2] for override in job) for job in jobs]
    varied = {
        number: [override for override in shlex.split(outcome.overrides) if override not in grid.shared]
        for number, outcome in outcomes.items()
    }
    tested = [(Path(run.data.tags[FOLDER_TAG]), varied[run.data.tags[JOB_TAG]]) for run in finished]
    table = folds_table(tested, _n_folds(finished, len({job[FOLD] for job in planned})))
    if table is None:
        return None
    if _task_differences(finished):
        # The best of them would be the easiest.
        table = replace(table, headline="")
    left_out = len(planned) - len(finished)
    missing = f"{left_out} of {len(planned)} jobs are missing: the table is over the folds that all seeds tested on"
    of_agent = next(each for title, each in table.results.items() if title.startswith("agent, "))
    return table, [*([missing] if left_out else []), *few_subjects({"test ": of_agent})]

"""`armscan report`: the HTML report of a study, or of runs compared."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

import click

from armscan.cli.options import FILE_PATH, examples, is_given, storage_option, tracking_option
from armscan.errors import InvalidValueError, StorageUnavailableError, StudyError, listed
from armscan.utils.files import nearest_existing
from armscan.utils.retry import no_retry

# Seconds between two updates of a watched report.
WATCH_S = 10
# The option with the store of each kind of report.
PLACES = {"study": "storage", "runs": "tracking"}


@click.command(epilog=examples("report --study sac_y", "report --study sac_y --watch", "report --runs 4f2a,91c0"))
@click.option("--study", metavar="NAME", help="Report on this study.")
@click.option(
    "--runs",
    metavar="ID,ID,...",
    help="Compare these runs: MLflow run IDs or their beginnings. A grid, a study or a trial stands for all "
    "trainings below it, experiment:NAME for an MLflow experiment.",
)
@click.option(
    "--out",
    type=FILE_PATH,
    metavar="FOLDER",
    help="Folder of the report.  [default: one in reports]",
)
@click.option("--watch", is_flag=True, help="Rewrite the report of a study until Ctrl-C; the browser reloads it.")
@storage_option(help="Optuna storage of the study.")
@tracking_option(help="MLflow tracking store of the runs.")
def report(study: str | None, runs: str | None, out: Path | None, watch: bool, storage: str, tracking: str) -> None:
    """Report on a study, or compare runs.

    The report is one HTML file that needs no server, with its numbers as CSV beside it. The study or the runs may still
    be running. docs/reports.md explains how to read it.
    """
    if (study is None) == (runs is None):
        given = "neither --study nor --runs is given" if study is None else "--study and --runs are both given"
        raise click.UsageError(f"{given}, but a report is of one of them: give --study NAME or --runs ID,ID")
    of, other = ("study", "runs") if runs is None else ("runs", "study")
    if is_given(PLACES[other]):
        raise click.UsageError(f"--{PLACES[other]} is given, but it is for --{other}, and this report is of --{of}")
    if watch and runs is not None:
        raise click.UsageError("--watch is given, but it is for --study, and this report is of --runs")
    if out is not None:
        nearest = nearest_existing(out)
        if not nearest.is_dir():
            raise InvalidValueError(f"--out is {str(out)!r}, but {nearest} is not a folder: name one, or a new one")
    if runs is not None:
        # Deferred: command-line errors are reported before these are loaded.
        from armscan.reports.runs import write_runs_report

        file = write_runs_report(runs, tracking, out)
    elif study is not None:
        write = _reporter_on_study(study, storage, out)
        if watch:
            _watch(write)
            return
        file = write(None)
    print(f"look at   {file}")


def _watch(write: Callable[[int | None], Path]) -> None:
    """Rewrite a report until Ctrl-C, then write it once more, without the automatic refresh."""
    print(f"look at   {write(WATCH_S)}", f"updated every {WATCH_S} s until Ctrl-C", sep="\n", flush=True)
    try:
        while True:
            time.sleep(WATCH_S)
            # While the storage is unavailable, the report stays as it is.
            with contextlib.suppress(StorageUnavailableError), no_retry():
                write(WATCH_S)
    finally:
        with contextlib.suppress(StorageUnavailableError), no_retry():
            write(None)


def _reporter_on_study(name: str, uri: str, out: Path | None) -> Callable[[int | None], Path]:
    """Return a function that writes the current report of a study, for a browser that reloads it every few seconds."""
    from armscan.sweeps.results.report import write_report
    from armscan.sweeps.storage.attributes import FINAL_SUFFIXES, TEST_SUFFIX, check_trials
    from armscan.sweeps.storage.storage import existing_storage
    from armscan.sweeps.study.final_eval_storage import stored_final_eval
    from armscan.sweeps.study.settings import check_study_name
    from armscan.sweeps.study.study import is_ours

    check_study_name("--study", name)
    storage = existing_storage(uri, where="--storage")
    if storage is None:
        raise StudyError(f"--storage is {uri!r}, but there is no storage: give the one that contains the study")
    study = storage.study(name)
    if study is None:
        others = [each for each in storage.study_names if not each.endswith(FINAL_SUFFIXES)]
        there = f"there is only {listed(others)}" if others else "there is no study"
        raise StudyError(f"--study is {name!r}, but {there} in {storage.uri!r}")
    if not is_ours(study):
        raise StudyError(f"--study is {name!r}, but that one in {storage.uri!r} was not made by armscan")

    def write(refresh_s: int | None) -> Path:
        check_trials(study)
        evaluated = []
        if (final := storage.study(name + TEST_SUFFIX)) is not None:
            check_trials(final, n_searched=len(study.get_trials(deepcopy=False)))
            evaluated = final.get_trials(deepcopy=False)
        stored = stored_final_eval(storage, study)
        return write_report(study, evaluated, out or Path("reports", name), final=stored, refresh_s=refresh_s)

    return write

"""Several jobs side by side: their parent run, and the outcome of each."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from armscan.config.command_hints import armscan_command, resume_command, run_command
from armscan.config.credentials import check_address
from armscan.config.defaults import RESUME, TRACKING_URI, to_plain
from armscan.config.error_messages import one_line_message
from armscan.config.task import have_same_task
from armscan.config.trust import needs_trust, untrusted_override
from armscan.errors import InvalidValueError, ResumeError, TrackingError, print_error
from armscan.experiment.job import (
    INTERRUPTED,
    NO_OUTCOME,
    OUTCOME_FOLDER,
    Grid,
    JobOutcome,
    remove_run_folder,
)
from armscan.launch.grid_jobs import shared_overrides
from armscan.launch.launchers import LAUNCHER, ON_THIS_MACHINE, check_launcher, prepare_launcher
from armscan.tracking import (
    TrackingSettings,
    TrackingStore,
    begin_outbox,
    code_state,
    open_store,
    record_end,
    sync,
    upload_pending,
)
from armscan.tracking.sync import PROCESS_DIED
from armscan.tracking.tags import (
    CONTINUED_TAG,
    FAILURE_TAG,
    FOLDER_TAG,
    GRID_TAG,
    JOB_TAG,
    OVERRIDES_TAG,
    WORKING_FOLDER_TAG,
)
from armscan.utils.processes import ProcessInfo
from armscan.utils.run_files import LAST_CHECKPOINT, RESULTS_PAGE

if TYPE_CHECKING:
    from mlflow.entities import Run

    from armscan.tracking.outbox import Outbox

# Hydra's own overrides that select the multirun mode and its folder.
NOT_REPEATED = ("hydra.mode=", "hydra.sweep.dir=", "hydra.sweep.subdir=")


class Multirun(Callback):
    """Starts the parent run before the first job; Hydra calls it in the process that launches the jobs.

    Starting the parent also creates the store's tables, before jobs start side by side.
    """

    folder: Path | None = None
    grid: Grid | None = None
    launcher: str | None = None
    # Of the parent run; open while the jobs run.
    outbox: Outbox | None = None
    # Run ID of the grid that this one repeats without its finished jobs, and whether they may build any class.
    repeats: str | None = None
    is_trusted = True

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Check the addresses that a single run would store."""
        with _exit_on_error():
            for key in (TRACKING_URI, "study.storage"):
                if isinstance(uri := OmegaConf.select(config, key), str):
                    check_address(key, uri)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Open the store, start the parent run and write its ID for the jobs."""
        self.on_run_start(config)
        with _exit_on_error():
            self._start(config)

    @staticmethod
    def _start(config: DictConfig) -> None:
        if config.get("study") is not None:
            # A study has its own run, which continues when workers are started again.
            return
        launcher = config.hydra.runtime.choices[LAUNCHER]
        check_launcher(launcher)
        prepare_launcher(launcher)
        folder = Path(config.hydra.sweep.dir)
        print(f"preparing a grid in {folder}", flush=True)
        if not isinstance(config.tracking, DictConfig):
            raise InvalidValueError(f"tracking is {config.tracking!r}, but it must be a section, such as its default")
        tracking = to_plain(config.tracking)
        TrackingSettings.read("tracking", tracking)
        overrides = list(config.hydra.overrides.task)
        store, experiment_id = open_store(**tracking)
        if Multirun.repeats is not None:
            _check_not_continued(store, experiment_id, Multirun.repeats)
        # Ends what dead processes have left running, such as the grid that is repeated.
        upload_pending(store)
        (folder / OUTCOME_FOLDER).mkdir(parents=True)
        again = _repeating(config, tracking["uri"])
        run = _parent_run(store, experiment_id, overrides, again)
        was_resumed_with_trust = Multirun.repeats is not None and Multirun.is_trusted
        grid = Grid(
            run_id=run.info.run_id,
            tracking=tracking,
            overrides=overrides,
            shared=shared_overrides(OverridesParser.create().parse_overrides([*overrides])),
            has_known_jobs=config.hydra.runtime.choices["hydra/sweeper"] == "basic",
            resume_needs_trust=was_resumed_with_trust or untrusted_override(again, tracking["uri"]) is not None,
            repeats=Multirun.repeats,
            is_trusted=Multirun.is_trusted,
            launcher=ProcessInfo.current() if launcher in ON_THIS_MACHINE else None,
        )
        try:
            grid.write(folder)
            Multirun.outbox = begin_outbox(folder, run.info.run_id, tracking["uri"])
        # A full disk: the run would stay RUNNING.
        except OSError:
            store.delete_run(run.info.run_id)
            raise
        Multirun.folder, Multirun.grid, Multirun.launcher = folder, grid, launcher


def _repeating(config: DictConfig, uri: str) -> list[str]:
    """Return the overrides that repeat a grid: its own, and the tracking URI, because the environment may differ."""
    hydra_overrides = [each for each in config.hydra.overrides.hydra if not each.startswith(NOT_REPEATED)]
    tracking = f"{TRACKING_URI}={QuotedString(uri, Quote.single).with_quotes()}"
    return [*config.hydra.overrides.task, *hydra_overrides, tracking]


def _parent_run(store: TrackingStore, experiment_id: str, overrides: Sequence[str], again: Sequence[str]) -> Run:
    """Create the parent run of a grid, and note it in the run of the grid that it repeats."""
    command = " ".join(overrides)
    tags = {
        **code_state().tags,
        OVERRIDES_TAG: command,
        WORKING_FOLDER_TAG: str(Path.cwd()),
        GRID_TAG: json.dumps(again),
    }
    run = store.create_run(experiment_id, name=f"grid {command}", tags=tags)
    if Multirun.repeats is not None:
        store.set_tag(Multirun.repeats, CONTINUED_TAG, run.info.run_id)
    return run


def _check_not_continued(store: TrackingStore, experiment_id: str, run_id: str) -> None:
    """Raise `ResumeError` if another grid continues a grid, and has taken over its jobs."""
    later = store.get_run(run_id).data.tags.get(CONTINUED_TAG, "")
    # A grid is deleted if none of its jobs has begun.
    if later.isalnum() and store.runs([experiment_id], f"attributes.run_id IN ('{later}')"):
        raise ResumeError(f"run {run_id} is continued by run {later}: resume that one, {RESUME}={later}")


@contextmanager
def _exit_on_error() -> Iterator[None]:
    """Report an error in one line and exit: Hydra only warns of a callback's exception, and starts the jobs."""
    try:
        yield
    except Exception as error:
        print_error(one_line_message(error) or repr(error))
        raise SystemExit(2) from error


def end_grid(*, is_interrupted: bool = False) -> int:
    """Close the parent run and print the outcomes of the jobs.

    Args:
        is_interrupted: Whether the grid was interrupted. Default: False.

    Returns:
        The exit code: 0 if every job succeeded, or if this was not a grid; 1 otherwise.
    """
    if Multirun.folder is None or (grid := Multirun.grid) is None:
        return 0
    folder, outcomes = Multirun.folder, _read_outcomes(Multirun.folder)
    failed = {number: outcome for number, outcome in outcomes.items() if outcome.failure is not None}
    # An interruption is not a failure: of one job, by `armscan runs stop`, or of all, when some write no outcome.
    endings = (INTERRUPTED, NO_OUTCOME) if is_interrupted else (INTERRUPTED,)
    interrupted = {number for number, outcome in failed.items() if outcome.failure in endings}
    outcomes |= {number: replace(failed.pop(number), failure=INTERRUPTED) for number in interrupted}
    has_failed = bool(failed) or not outcomes
    status = "KILLED" if is_interrupted or (interrupted and not has_failed) else "FAILED" if has_failed else "FINISHED"
    try:
        store, runs = _close_parent(folder, grid, status, outcomes)
    except (TrackingError, OSError) as error:
        again = armscan_command("runs", "sync", str(folder))
        print(f"{one_line_message(error) or error}; {again} uploads the rest", file=sys.stderr)
        if outcomes:
            table_command = armscan_command("report", "--runs", grid.run_id, tracking=grid.uri)
            print(f"the grid's run lacks the table of its jobs; {table_command} makes one", file=sys.stderr)
        store, runs = None, []
    if outcomes:
        from armscan.experiment.console import print_where_to_look
        from armscan.launch.grid_tables import keep_tables, print_jobs

        run_ids = {run.data.tags[JOB_TAG]: run.info.run_id for run in runs}
        table = print_jobs(outcomes, run_ids, have_same_task=have_same_task(run.data.params for run in runs))
        if store is not None and runs:
            keep_tables(table, folder, grid, outcomes, runs, store)
            print_where_to_look(folder, grid.uri, files=(RESULTS_PAGE, ""))
            compare = armscan_command("report", "--runs", grid.run_id, tracking=grid.uri)
            print(f"compare   {compare}")
    for number, outcome in failed.items():
        print(f"job {number} failed: {outcome.failure}", file=sys.stderr)
        print(f"  run it alone with: {run_command([])} {outcome.overrides}", file=sys.stderr)
    if status != "FINISHED":
        _print_resume_commands(grid, runs)
        if store is None:
            print_resume_command()
    if store is not None and not runs:
        remove_run_folder(folder)
        if is_interrupted:
            print("no run had begun: type the command again", file=sys.stderr)
    return 0 if status == "FINISHED" else 1


def print_resume_command() -> None:
    """Print the command that resumes a grid that could not be closed."""
    if (grid := Multirun.grid) is not None:
        again = resume_command(grid.run_id, grid.uri, trust=grid.resume_needs_trust)
        print(f"the grid was not closed; resume it with: {again}", file=sys.stderr)


def _read_outcomes(folder: Path) -> dict[str, JobOutcome]:
    """Return the outcomes of the jobs by their numbers."""
    files = sorted((folder / OUTCOME_FOLDER).glob("*.json"), key=lambda file: int(file.stem))
    return {file.stem: JobOutcome(**json.loads(file.read_text())) for file in files}


def _print_resume_commands(grid: Grid, runs: Sequence[Run]) -> None:
    """Print the commands that resume the jobs that have not finished."""
    for run in runs:
        if run.info.status != "FINISHED" and (Path(run.data.tags[FOLDER_TAG]) / LAST_CHECKPOINT).exists():
            again = resume_command(run.info.run_id, grid.uri, trust=needs_trust(run.data.params))
            print(f"resume job {run.data.tags[JOB_TAG]} with: {again}", file=sys.stderr)
    if runs:
        again = resume_command(grid.run_id, grid.uri, trust=grid.resume_needs_trust)
        print(f"resume all with: {again}", file=sys.stderr)


def _close_parent(
    folder: Path, grid: Grid, status: str, outcomes: Mapping[str, JobOutcome]
) -> tuple[TrackingStore, list[Run]]:
    """Close the parent run and the open runs of killed jobs; delete the parent if no job has started a run.

    Returns:
        The tracking store, and the runs of the jobs that started one, in the order of the jobs.
    """
    from armscan.launch.best_job import log_best

    failed = {number: each for number, each in outcomes.items() if each.failure not in (None, INTERRUPTED)}
    tags = {f"failure.{number}": f"{each.varied}: {each.failure}" for number, each in failed.items()}
    if Multirun.outbox is not None:
        Multirun.outbox.close()
    record_end(folder, grid.run_id, grid.uri, status, tags)
    store, experiment_id = open_store(**grid.tracking, retry_s=grid.tracking["wait_s"])
    # Uploads what the jobs could not while the store was unavailable.
    sync(folder, lambda _: store)
    below = store.children(experiment_id, grid.run_id)
    # Users may have nested other runs below it.
    children = [run for run in below if run.data.tags.get(JOB_TAG, "").isdecimal() and FOLDER_TAG in run.data.tags]
    for child in children:
        # `sync` has closed the runs whose processes could not.
        if child.info.status == "RUNNING" or child.data.tags.get(FAILURE_TAG) == PROCESS_DIED:
            outcome = outcomes.get(child.data.tags[JOB_TAG])
            reason = (outcome.failure if outcome is not None else None) or NO_OUTCOME
            is_killed = reason == INTERRUPTED
            store.set_tag(child.info.run_id, FAILURE_TAG, reason)
            store.set_terminated(child.info.run_id, "KILLED" if is_killed else "FAILED")
    if not children:
        store.delete_run(grid.run_id)
    else:
        done = {number for number, outcome in outcomes.items() if outcome.failure is None}
        log_best(store, grid.run_id, [child for child in children if child.data.tags[JOB_TAG] in done])
    return store, sorted(children, key=lambda child: int(child.data.tags[JOB_TAG]))

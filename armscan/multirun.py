"""Several jobs side by side: their common parent run, and what became of each."""

from __future__ import annotations

import contextlib
import json
import shlex
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from armscan.errors import FolderInUseError, FolderTakenError, InvalidValueError, TrackingError
from armscan.files import CONFIG_FILE, LAST_CHECKPOINT, LOCK_FILE, RUN_ID, SPOOL_SUFFIXES, SPOOLS, write_whole
from armscan.launchers import LAUNCHER, check_launcher
from armscan.mistakes import mistake_in_one_line
from armscan.passwords import check_written
from armscan.settings import TRACKING_URI, compare_command, plain, resume_command

if TYPE_CHECKING:
    from mlflow.entities import Run

PARENT_FILE = "parent_run.json"
OUTCOME_FOLDER = "outcomes"
# Of a job's run: its number.
JOB_TAG = "job"
NO_OUTCOME, INTERRUPTED = "ended without a word", "interrupted"


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Args:
        overrides: all of its overrides.
        varied: those that tell it from the other jobs.
        failure: why it failed, None where it did not.
        figures: of its evaluations, by the name of their volumes.
    """

    overrides: str
    varied: str
    failure: str | None = None
    figures: dict[str, dict[str, float]] = field(default_factory=dict)

    def is_failed(self, *, is_interrupted: bool) -> bool:
        """Whether something went wrong; to be interrupted is no failure where the whole multirun was."""
        return self.failure is not None and not (is_interrupted and self.failure == INTERRUPTED)

    def interrupted(self) -> Outcome:
        """Returns the outcome of a job whose multirun was interrupted: its own, if it had one by then."""
        return replace(self, failure=INTERRUPTED) if self.failure == NO_OUTCOME else self


class Multirun(Callback):
    """Starts the parent run before the first job; Hydra calls it in the process that launches the jobs.

    The parent also makes the store's tables, so that jobs starting side by side find them there.
    """

    folder: Path | None = None
    # Whether what has finished of an earlier one is not run again.
    is_repeated = False

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Checks what a single run would write down."""
        self._answered(self._check, config)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Opens the store, starts the parent run, and leaves word of it for the jobs."""
        self._answered(self._check, config)
        self._answered(self._start, config)

    @staticmethod
    def _answered(begin: Callable[[DictConfig], None], config: DictConfig) -> None:
        try:
            begin(config)
        # Hydra would turn any exception of a callback into a warning, and start the jobs all the same.
        except Exception as error:
            print(f"error: {mistake_in_one_line(error) or repr(error)}", file=sys.stderr)
            raise SystemExit(2) from error

    @staticmethod
    def _check(config: DictConfig) -> None:
        for key in (TRACKING_URI, "study.storage"):
            if isinstance(uri := OmegaConf.select(config, key), str):
                check_written(key, uri)

    @staticmethod
    def _start(config: DictConfig) -> None:
        from armscan.tracking import open_store, source_tags

        if config.get("study") is not None:
            # It has a run of its own, which outlives many starts of workers.
            return
        check_launcher(config.hydra.runtime.choices[LAUNCHER])
        folder = Path(config.hydra.sweep.dir)
        if not isinstance(config.tracking, DictConfig):
            raise InvalidValueError(f"tracking is {config.tracking!r}, but it must be a section, such as its default")
        tracking = plain(config.tracking)
        overrides = list(config.hydra.overrides.task)
        client, experiment_id = open_store(**tracking)
        (folder / OUTCOME_FOLDER).mkdir(parents=True)
        command = " ".join(overrides)
        tags = {**source_tags(), "overrides": command}
        parent = client.create_run(experiment_id, name=f"multirun {command}"[:250], tags=tags)
        word = {"run_id": parent.info.run_id, "tracking": tracking, "overrides": overrides}
        word["is_repeated"] = Multirun.is_repeated
        (folder / PARENT_FILE).write_text(json.dumps(word))
        Multirun.folder = folder


@dataclass(frozen=True)
class Job:
    """One job of a multirun, as its own process sees it.

    Args:
        number: from 0.
        overrides: all of its overrides, as one would write them to run it alone.
        varied: those among them that tell it from the other jobs.
        parent_run_id: the run that its run is a child of.
        folder: of the multirun.
        is_repeated: whether it need not run where it has finished before.
    """

    number: int
    overrides: str
    varied: str
    parent_run_id: str
    folder: Path
    is_repeated: bool = False

    @classmethod
    def current(cls) -> Self | None:
        """Returns the job that this process is running, None outside a multirun."""
        hydra_config = HydraConfig.get()
        if hydra_config.mode != RunMode.MULTIRUN:
            return None
        folder = Path(hydra_config.sweep.dir)
        word = json.loads((folder / PARENT_FILE).read_text())
        overrides = list(hydra_config.overrides.task)
        # Hydra hands a truth value on as it writes it, False for false.
        common = {override.lower() for override in word["overrides"]}
        varied = [override for override in overrides if override.lower() not in common]
        return cls(
            hydra_config.job.num,
            shlex.join(overrides),
            " ".join(varied),
            word["run_id"],
            folder,
            is_repeated=word["is_repeated"],
        )

    @property
    def label(self) -> str:
        """What stands before the lines it prints."""
        return f"{self.number} {self.varied}".strip()

    def write_outcome(self, *, failure: str | None = None, figures: dict[str, dict[str, float]] | None = None) -> None:
        """Leaves word of the outcome for the process that launched the job."""
        outcome = Outcome(self.overrides, self.varied, failure, figures or {})
        file = self.folder / OUTCOME_FOLDER / f"{self.number}.json"
        write_whole(file, lambda opened: opened.write(json.dumps(asdict(outcome)).encode()))


def end_multirun(*, is_interrupted: bool = False) -> int:
    """Closes the parent run and shows what became of the jobs.

    Args:
        is_interrupted: whether somebody stopped the multirun.

    Returns:
        The exit code: 0 where every job succeeded, or where this was no multirun; 1 otherwise.
    """
    if Multirun.folder is None:
        return 0
    files = sorted((Multirun.folder / OUTCOME_FOLDER).glob("*.json"), key=lambda file: int(file.stem))
    outcomes = {file.stem: Outcome(**json.loads(file.read_text())) for file in files}
    if is_interrupted:
        outcomes = {number: outcome.interrupted() for number, outcome in outcomes.items()}
    failed = {
        number: outcome for number, outcome in outcomes.items() if outcome.is_failed(is_interrupted=is_interrupted)
    }
    status = "KILLED" if is_interrupted else "FAILED" if failed or not outcomes else "FINISHED"
    word = json.loads((Multirun.folder / PARENT_FILE).read_text())
    try:
        runs, is_known = _close_parent(Multirun.folder, word, status, failed), True
    except TrackingError as error:
        print(f"{error}; python -m armscan.track sync {Multirun.folder} delivers the rest", file=sys.stderr)
        runs, is_known = [], False
    if outcomes:
        from armscan.console import print_jobs, print_where_to_look

        print_jobs(outcomes, {run.data.tags[JOB_TAG]: run.info.run_id for run in runs})
        if runs:
            print_where_to_look(Multirun.folder, word["tracking"]["uri"])
            print(f"compare   {compare_command(word['run_id'], word['tracking']['uri'])}")
    for number, outcome in failed.items():
        print(f"job {number} failed: {outcome.failure}", file=sys.stderr)
        print(f"  again alone: python -m armscan.run {outcome.overrides}", file=sys.stderr)
    for run in runs:
        if run.info.status != "FINISHED" and (Path(run.data.tags["folder"]) / LAST_CHECKPOINT).exists():
            again = resume_command(run.info.run_id, word["tracking"]["uri"])
            print(f"resume job {run.data.tags[JOB_TAG]} with: {again}", file=sys.stderr)
    if is_known and not runs:
        remove_run_folder(Multirun.folder)
    return 1 if failed or not outcomes else 0


def _close_parent(folder: Path, word: Mapping[str, Any], status: str, failed: Mapping[str, Outcome]) -> list[Run]:
    """Closes the parent run and what a killed job left open; deletes it where no job got as far as a run of its own.

    Returns:
        The runs of those that got as far as that, in the order of the jobs.

    Raises:
        TrackingError: if the store is away for longer than a run waits for it at its end.
    """
    from armscan.tracking import note_end, open_store, sync

    tags = {f"failure.{number}": f"{each.varied}: {each.failure}" for number, each in failed.items()}
    note_end(folder, word["run_id"], word["tracking"]["uri"], status, tags)
    store, experiment_id = open_store(**word["tracking"], patience_s=word["tracking"]["wait_s"])
    # With what jobs have left because the store was away.
    sync(folder, lambda _: store)
    children = store.search_runs([experiment_id], f"tags.mlflow.parentRunId = '{word['run_id']}'")
    for child in children:
        if child.info.status == "RUNNING":
            is_killed = status == "KILLED"
            store.set_tag(child.info.run_id, "failure", INTERRUPTED if is_killed else NO_OUTCOME)
            store.set_terminated(child.info.run_id, "KILLED" if is_killed else "FAILED")
    if not children:
        store.delete_run(word["run_id"])
    return sorted(children, key=lambda child: int(child.data.tags[JOB_TAG]))


def remove_if_untracked(folder: Path, error: BaseException) -> None:
    """Removes what a run has left that failed before it was tracked; from then on it can be resumed."""
    is_tracked = (folder / CONFIG_FILE).exists() and not isinstance(error, FolderTakenError)
    # Where somebody else is at work in the folder, everything is theirs.
    if not is_tracked and not isinstance(error, FolderInUseError):
        remove_run_folder(folder)


def remove_run_folder(folder: Path) -> None:
    """Removes what a run that came to nothing has left in its folder, and the folders that are empty then.

    Nothing else is touched: the folder may be one that somebody named, with other files in it.
    """
    for ours in (folder / ".hydra", folder / OUTCOME_FOLDER):
        shutil.rmtree(ours, ignore_errors=True)
    for ours in (folder / PARENT_FILE, folder / "multirun.yaml", folder / LOCK_FILE):
        ours.unlink(missing_ok=True)
    for ours in (file for suffix in SPOOL_SUFFIXES for file in (folder / SPOOLS).glob(RUN_ID + suffix)):
        ours.unlink(missing_ok=True)
    # Somebody else's is not empty.
    with contextlib.suppress(OSError):
        (folder / SPOOLS).rmdir()
    here = Path.cwd()
    for emptied in (folder, folder.parent, folder.parent.parent):
        if here.is_relative_to(emptied.resolve()) or not emptied.is_dir() or any(emptied.iterdir()):
            break
        emptied.rmdir()

"""The invocation of a run: its folder, its overrides, and its job of a grid.

It has no slow imports, because a grid's launcher imports it for every job.
"""

from __future__ import annotations

import contextlib
import json
import shlex
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from armscan.config.command_hints import kept_command
from armscan.config.defaults import CHOICES
from armscan.config.sources import SWEEP
from armscan.errors import FolderInUseError, FolderTakenError, InvalidValueError, reason_of
from armscan.utils.files import atomic_write, sha256
from armscan.utils.processes import ProcessInfo
from armscan.utils.run_files import CONFIG_FILE, LOCK_FILE, OUTBOX_FOLDER, OUTBOX_SUFFIXES, RUN_ID_PATTERN

GRID_FILE = "grid.json"
OUTCOME_FOLDER = "outcomes"
NO_OUTCOME, INTERRUPTED = "ended without an outcome", "interrupted"


@dataclass(frozen=True)
class JobOutcome:
    """The outcome of a job.

    Args:
        overrides: All overrides of the job.
        varied: Overrides that differ from those of the other jobs.
        failure: Reason of its failure; None if it succeeded.
        metrics: Metrics by the names of the agent's volumes and of the baselines.
    """

    overrides: str
    varied: str
    failure: str | None = None
    metrics: dict[str, dict[str, float]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A grid, as its folder keeps it for its jobs and for its end.

    Args:
        run_id: MLflow run ID of its run, the parent of its jobs' runs.
        tracking: Section `tracking` of its configuration.
        overrides: Its overrides.
        shared: Overrides that all jobs share, as Hydra spells them for a job.
        has_known_jobs: Whether its jobs follow from its overrides, as those of Hydra's own sweeper do.
        resume_needs_trust: Whether it can only be resumed with `--trust`.
        repeats: MLflow run ID of the grid that it repeats without its finished jobs. Default: None, a new grid.
        is_trusted: Whether its jobs may build any class; false if its overrides were stored and not trusted.
            Default: True.
        launcher: Process that launches the jobs, which end with it. Default: None, they go on without it, as on a
            cluster.
    """

    run_id: str
    tracking: dict[str, Any]
    overrides: list[str]
    shared: list[str]
    has_known_jobs: bool = True
    resume_needs_trust: bool = False
    repeats: str | None = None
    is_trusted: bool = True
    launcher: ProcessInfo | None = None

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the grid of a folder.

        Raises:
            InvalidValueError: If its file is damaged.
        """
        try:
            values = json.loads((file := folder / GRID_FILE).read_text())
            launcher = ProcessInfo.of(values["launcher"]) if values["launcher"] else None
            return cls(**values | {"launcher": launcher})
        except (ValueError, TypeError, KeyError) as error:
            raise InvalidValueError(f"{file}: is damaged, its jobs cannot run: {reason_of(error)}") from error

    def write(self, folder: Path) -> None:
        """Write the grid into its folder."""
        atomic_write(folder / GRID_FILE, json.dumps(asdict(self)))

    @property
    def uri(self) -> str:
        """Address of its tracking store."""
        return str(self.tracking["uri"])


@dataclass(frozen=True)
class Job:
    """One job of a grid, as its own process sees it.

    Args:
        number: Number of the job, from 0.
        overrides: All overrides of the job, as one would type them to run it alone.
        varied: Overrides that differ from those of the other jobs.
        folder: Folder of the grid.
        grid: The grid.
    """

    number: int
    overrides: str
    varied: str
    folder: Path
    grid: Grid

    @classmethod
    def current(cls) -> Self | None:
        """Return the job that this process is running, None outside a grid."""
        hydra_config = HydraConfig.get()
        if hydra_config.mode != RunMode.MULTIRUN:
            return None
        folder = Path(hydra_config.sweep.dir)
        grid, overrides = Grid.read(folder), list(hydra_config.overrides.task)
        return cls(
            hydra_config.job.num,
            shlex.join(overrides),
            " ".join(override for override in overrides if override not in grid.shared),
            folder,
            grid,
        )

    @property
    def label(self) -> str:
        """The prefix of the lines that the job prints."""
        return f"{self.number} {self.varied}".strip()

    def claims(self, folder: Path) -> bool:
        """Return whether this job is the first of its grid to use a folder, and keep that for the others."""
        file = self.folder / OUTCOME_FOLDER / f"{sha256(str(folder).encode())}.folder"
        with contextlib.suppress(FileExistsError), file.open("x") as opened:
            opened.write(str(self.number))
        # The same job may be started again, as after a requeue.
        return file.read_text() == str(self.number)

    def write_outcome(self, *, failure: str | None = None, metrics: dict[str, dict[str, float]] | None = None) -> None:
        """Write the outcome for the process that launched the job."""
        outcome = JobOutcome(self.overrides, self.varied, failure, metrics or {})
        file = self.folder / OUTCOME_FOLDER / f"{self.number}.json"
        atomic_write(file, json.dumps(asdict(outcome)))


@dataclass(frozen=True)
class Invocation:
    """The invocation of a run.

    Args:
        folder: Folder of the run's files.
        overrides: Overrides on the command line.
        command: Command line; for a job, the one that repeats it alone.
        choices: Choice of each configuration group.
        job: Job of a grid. Default: None, no grid.
    """

    folder: Path
    overrides: list[str]
    command: str
    choices: dict[str, str]
    job: Job | None = None

    @classmethod
    def current(cls) -> Self:
        """Return how Hydra is running this process."""
        hydra_config = HydraConfig.get()
        return cls(
            folder=Path(hydra_config.runtime.output_dir),
            overrides=list(hydra_config.overrides.task),
            command=kept_command(hydra_config.overrides.task),
            choices={str(group): str(choice) for group, choice in hydra_config.runtime.choices.items()},
            job=Job.current(),
        )


def check_folder_stays(overrides: Sequence[str]) -> None:
    """Raise `InvalidValueError` if a command line asks Hydra to change to the folder of each run."""
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        if key == "hydra.job.chdir" and value.lower() != "false":
            raise InvalidValueError(
                f"{key} is {value!r}, but it must be false: relative paths, the store's too, begin where it was started"
            )


def check_choices(overrides: Sequence[str]) -> None:
    """Raise `InvalidValueError` if a command line adds a study, removes another group, or gives it a list."""
    for override in overrides:
        key, _, value = override.partition("=")
        group = key.lstrip("+~")
        if (group == SWEEP and key != SWEEP) or group.startswith(f"{SWEEP}/"):
            raise InvalidValueError(f"{override!r} is not allowed: a study is {SWEEP}=NAME")
        is_list = "[" in value and not value.startswith("glob(")
        if group in CHOICES and (key.startswith("~") or is_list):
            raise InvalidValueError(
                f"{override!r} is not allowed: a run has one {group}, {group}=NAME (armscan run --help lists the names)"
            )


def remove_if_untracked(folder: Path, error: BaseException) -> None:
    """Remove the files of a run that failed before it was tracked; a tracked run can be resumed."""
    is_tracked = (folder / CONFIG_FILE).exists() and not isinstance(error, FolderTakenError)
    # If another process is using the folder, its files are that process's.
    if not is_tracked and not isinstance(error, FolderInUseError):
        remove_run_folder(folder)


def remove_run_folder(folder: Path) -> None:
    """Remove the files of a run that produced nothing from its folder, and the folders that this leaves empty.

    Nothing else is touched: the folder may have been named by the user, with other files in it.
    """
    for ours in (folder / ".hydra", folder / OUTCOME_FOLDER):
        shutil.rmtree(ours, ignore_errors=True)
    outboxes = [file for suffix in OUTBOX_SUFFIXES for file in (folder / OUTBOX_FOLDER).glob(RUN_ID_PATTERN + suffix)]
    for ours in (folder / GRID_FILE, folder / "multirun.yaml", folder / LOCK_FILE, *outboxes):
        ours.unlink(missing_ok=True)
    # Another run's outbox is not empty.
    with contextlib.suppress(OSError):
        (folder / OUTBOX_FOLDER).rmdir()
    here = Path.cwd()
    for emptied in (folder, folder.parent, folder.parent.parent):
        if here.is_relative_to(emptied.resolve()) or not emptied.is_dir() or any(emptied.iterdir()):
            break
        emptied.rmdir()

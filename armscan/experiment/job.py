"""One job of a multirun, as its own process sees it, and its outcome."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Self

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from armscan.utils.files import atomic_write

PARENT_FILE = "parent_run.json"
OUTCOME_FOLDER = "outcomes"
# Of a job's run: its number.
JOB_TAG = "job"
# Of a grid: the words that it is repeated with.
GRID_TAG = "grid"
NO_OUTCOME, INTERRUPTED = "ended without a word", "interrupted"


@dataclass(frozen=True)
class JobOutcome:
    """The outcome of a job.

    Args:
        overrides: all of its overrides.
        varied: overrides that differ from those of the other jobs.
        failure: why it failed, None where it did not.
        metrics: of its evaluations, by the name of their volumes.
    """

    overrides: str
    varied: str
    failure: str | None = None
    metrics: dict[str, dict[str, float]] = field(default_factory=dict)

    def is_failed(self, *, is_interrupted: bool) -> bool:
        """Whether something went wrong; to be interrupted is no failure where the whole multirun was."""
        return self.failure is not None and not (is_interrupted and self.failure == INTERRUPTED)

    def interrupted(self) -> JobOutcome:
        """Return the outcome of a job whose multirun was interrupted: its own, if it had one by then."""
        return replace(self, failure=INTERRUPTED) if self.failure == NO_OUTCOME else self


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
        """Return the job that this process is running, None outside a multirun."""
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
        """The prefix of the lines that the job prints."""
        return f"{self.number} {self.varied}".strip()

    def write_outcome(self, *, failure: str | None = None, metrics: dict[str, dict[str, float]] | None = None) -> None:
        """Leave word of the outcome for the process that launched the job."""
        outcome = JobOutcome(self.overrides, self.varied, failure, metrics or {})
        file = self.folder / OUTCOME_FOLDER / f"{self.number}.json"
        atomic_write(file, lambda opened: opened.write(json.dumps(asdict(outcome)).encode()))

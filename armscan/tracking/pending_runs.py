"""This machine's pending runs: they may have entries to upload, or have not ended."""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

from armscan.utils.files import atomic_write, cache_folder
from armscan.utils.processes import ProcessInfo

PENDING_FOLDER = "undelivered"


def forget(run_id: str) -> None:
    """Remove a run from this machine's pending runs, once everything is uploaded or the run is deleted."""
    with contextlib.suppress(OSError):
        (cache_folder() / PENDING_FOLDER / run_id).unlink(missing_ok=True)


@dataclass(frozen=True)
class PendingRun:
    """A run on this machine that may have entries to upload, or may not have ended.

    Args:
        outbox: File of the run's outbox.
        uri: Address of the run's tracking store.
        process: Process that tracks the run.
    """

    outbox: Path
    uri: str
    process: ProcessInfo

    @classmethod
    def of(cls, run_id: str) -> Self | None:
        """Return a run if it is pending here, else None; earlier versions wrote a link to the outbox."""
        file = cache_folder() / PENDING_FOLDER / run_id
        try:
            if file.is_symlink():
                return cls(file.readlink(), "", ProcessInfo.of({}))
            told = json.loads(file.read_bytes())
            return cls(Path(told["outbox"]), str(told["uri"]), ProcessInfo.of(told["process"]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None

    def write(self, file: Path) -> None:
        """Write the record to a file."""
        told = {"outbox": str(self.outbox), "uri": self.uri, "process": asdict(self.process)}
        atomic_write(file, json.dumps(told))

    @property
    def is_dead(self) -> bool:
        """Whether the process that tracked the run is known to have died."""
        return self.process.is_here and not self.process.is_alive


def pending_runs() -> dict[str, PendingRun]:
    """Return this machine's pending runs by run ID."""
    names = sorted(file.name for file in (cache_folder() / PENDING_FOLDER).glob("*"))
    return {name: pending for name in names if (pending := PendingRun.of(name)) is not None}

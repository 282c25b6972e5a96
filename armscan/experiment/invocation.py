"""How a run was asked for; it imports nothing that takes time, because a multirun's launcher needs it for every job."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

from hydra.core.hydra_config import HydraConfig

from armscan.config.command_hints import run_command
from armscan.experiment.job import Job


@dataclass(frozen=True)
class Invocation:
    """How a run was asked for.

    Args:
        folder: where it leaves its files.
        overrides: of the command line.
        command: that line.
        choices: what was chosen of each configuration group.
        job: which one of a multirun it is, None for a single run.
    """

    folder: Path
    overrides: list[str]
    command: str
    choices: dict[str, str]
    job: Job | None

    @classmethod
    def current(cls) -> Self:
        """Return how Hydra is running this process."""
        hydra_config = HydraConfig.get()
        return cls(
            folder=Path(hydra_config.runtime.output_dir),
            overrides=list(hydra_config.overrides.task),
            # Of a job: that which repeats it alone.
            command=run_command(hydra_config.overrides.task),
            choices={str(group): str(choice) for group, choice in hydra_config.runtime.choices.items()},
            job=Job.current(),
        )

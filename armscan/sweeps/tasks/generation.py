"""A generation of a member: the part of its training from its parent's checkpoint to the end of its interval."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from armscan.agents import Learner
from armscan.errors import CheckpointError, InvalidValueError
from armscan.experiment.build import RunSetup
from armscan.sweeps.tasks.attempt import Attempt
from armscan.training import EpochReport, take_over_checkpoints
from armscan.utils.run_files import RUN_FILE


def begin_generation(attempt: Attempt, setup: RunSetup, folder: Path, *, run_id: str) -> list[EpochReport]:
    """Restore the parent trial's last checkpoint into an untrained agent; do nothing in the first generation.

    Args:
        attempt: The attempt at the trial.
        setup: Setup of the run, with the agent.
        folder: Folder of the training; takes the checkpoints.
        run_id: ID of its tracked run.

    Returns:
        The reports of the epochs before the generation.

    Raises:
        CheckpointError: If the checkpoints of the parent are missing or damaged.
    """
    if attempt.parent_folder is None:
        return []
    parent, agent = attempt.parent_folder / folder.name, setup.agent
    assert isinstance(agent, Learner)
    try:
        theirs = setup.provenance(json.loads((parent / RUN_FILE).read_text())["run_id"])
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise CheckpointError(f"{parent / RUN_FILE}: cannot be read, which the next generation needs") from error
    return take_over_checkpoints(agent, parent, folder, theirs=theirs, own=setup.provenance(run_id))


def inherited(attempt: Attempt, reports: Sequence[EpochReport]) -> EpochReport | None:
    """Return the last epoch that a trial has inherited from its parent; None if there is none.

    Args:
        attempt: The attempt at the trial.
        reports: Reports of all epochs of its training.
    """
    start = attempt.interval[0] if attempt.interval else 0
    return next((report for report in reports if report.n_env_steps >= start), None) if start else None


def best_of_generation(reports: Sequence[EpochReport], before: EpochReport | None, best_by: str) -> EpochReport:
    """Return the best epoch that a trial has trained itself.

    Args:
        reports: Reports of all epochs of its training.
        before: Last epoch that it has inherited from its parent; None if there is none.
        best_by: Criterion that chooses the best epoch; see `Evaluation.score`.
    """
    own = [report for report in reports if before is None or report.epoch > before.epoch]
    if not own:
        raise InvalidValueError("study.sampler.interval_env_steps is so short that a generation has no epoch")
    return max(own, key=lambda report: report.evaluation.score(best_by))

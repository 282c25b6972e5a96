"""Checkpoints of a training: saved after each epoch, and resumed from.

`last.pt` holds the learner's full state and the reports of all epochs. It is written first, then `best.pt`, then the
callbacks are called. After a kill at any moment `last.pt` is therefore complete, and the rest is restored from it: if
its epoch is the best, it contains the weights of `best.pt`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armscan.agents.protocols import Learner
from armscan.errors import CheckpointError
from armscan.stats.on_plane import ON_PLANE
from armscan.training.callbacks import EpochReport, best_of
from armscan.training.checkpoint_file import load_checkpoint, save_checkpoint
from armscan.training.episode_results import Evaluation
from armscan.training.fingerprints import Fingerprints, check_unchanged, fingerprints_in
from armscan.utils.run_files import BEST_CHECKPOINT, LAST_CHECKPOINT


@dataclass(frozen=True, kw_only=True)
class CheckpointProvenance:
    """Provenance of a checkpoint: a training is resumed only from its own checkpoint, on the same volumes.

    Args:
        run_id: MLflow run ID.
        volumes: Fingerprints of the volumes, by split and name.
    """

    run_id: str = ""
    volumes: Fingerprints = field(default_factory=dict)

    def facts(self) -> dict[str, Any]:
        """Return the facts written into a checkpoint."""
        return {"run_id": self.run_id, "volumes": self.volumes}

    def check(self, path: Path, facts: dict[str, Any]) -> None:
        """Raise `CheckpointError` if a checkpoint is another run's, `ChangedVolumesError` if it is of other volumes."""
        if facts.get("run_id") != self.run_id:
            raise CheckpointError(
                f"{path}: is a checkpoint of run {facts.get('run_id')!r}, but this is {self.run_id!r}"
            )
        volumes = fingerprints_in(facts.get("volumes", {}), str(path))
        check_unchanged(volumes, self.volumes, f"{path} was trained with")


def save_checkpoints(
    learner: Learner, reports: Sequence[EpochReport], folder: Path, provenance: CheckpointProvenance | None
) -> None:
    """Write the last checkpoint, and the best one if the last epoch is better than all before."""
    _save_last(learner, reports, folder, provenance)
    if reports[-1].is_best:
        save_checkpoint(folder / BEST_CHECKPOINT, learner.weights(), _facts(reports[-1], provenance))


def resume_from_checkpoint(learner: Learner, folder: Path, provenance: CheckpointProvenance) -> list[EpochReport]:
    """Restore a learner to the state of its last checkpoint.

    Args:
        learner: Learner that has not learned anything yet.
        folder: Folder with the checkpoints.
        provenance: Provenance of this training.

    Returns:
        The reports of the epochs so far, for `train`; none if there is no checkpoint yet.

    Raises:
        CheckpointError: If a checkpoint is damaged or another run's, or the best one is missing or of another epoch.
        ChangedVolumesError: If a checkpoint is of other volumes.
    """
    last, best = folder / LAST_CHECKPOINT, folder / BEST_CHECKPOINT
    if not last.exists():
        return []
    reports = _restore(learner, last, provenance)
    best_report = best_of(reports)
    if best_report is reports[-1]:
        # A kill may have prevented this write.
        save_checkpoint(best, learner.weights(), _facts(best_report, provenance))
        return reports
    # Better refused now than after the training.
    best_facts = load_checkpoint(best)[1]
    provenance.check(best, best_facts)
    _check_best(folder, best_facts, best_report)
    return reports


def take_over_checkpoints(
    learner: Learner, source: Path, folder: Path, *, theirs: CheckpointProvenance, own: CheckpointProvenance
) -> list[EpochReport]:
    """Restore a learner to another training's last checkpoint, and save its checkpoints as this training's own.

    Args:
        learner: Learner that has learned nothing yet.
        source: Folder of the other training, which stays as it is.
        folder: Folder of this training.
        theirs: Provenance of the other training.
        own: Provenance of this training.

    Returns:
        The reports of the other training's epochs, for `train`.

    Raises:
        CheckpointError: If a checkpoint is missing, damaged or another run's, or the best one is of another epoch.
        ChangedVolumesError: If a checkpoint is of other volumes.
    """
    weights, best_facts = load_checkpoint(source / BEST_CHECKPOINT)
    theirs.check(source / BEST_CHECKPOINT, best_facts)
    reports = _restore(learner, source / LAST_CHECKPOINT, theirs)
    best_report = best_of(reports)
    _check_best(source, best_facts, best_report)
    save_checkpoint(folder / BEST_CHECKPOINT, weights, _facts(best_report, own))
    # Last, because from then on this training can be resumed.
    _save_last(learner, reports, folder, own)
    return reports


def _check_best(folder: Path, best_facts: dict[str, Any], best_report: EpochReport) -> None:
    """Raise `CheckpointError` if the best checkpoint is not of the best epoch that the last one reports."""
    if (epoch := best_facts.get("epoch")) != best_report.epoch:
        raise CheckpointError(
            f"{folder / BEST_CHECKPOINT}: is of epoch {epoch}, but the best epoch of {folder / LAST_CHECKPOINT} is "
            f"{best_report.epoch}"
        )


def _save_last(
    learner: Learner, reports: Sequence[EpochReport], folder: Path, provenance: CheckpointProvenance | None
) -> None:
    facts = _facts(reports[-1], provenance) | {"reports": _written(reports)}
    save_checkpoint(folder / LAST_CHECKPOINT, learner.state(), facts)


def _restore(learner: Learner, last: Path, provenance: CheckpointProvenance) -> list[EpochReport]:
    """Restore a learner to the state of a checkpoint; return the reports of all epochs until then."""
    state, facts = load_checkpoint(last)
    provenance.check(last, facts)
    reports = _read(facts.get("reports"), last)
    try:
        learner.load_state(state)
        n_env_steps = learner.n_env_steps
    # The checksum is right, so the state was written with other contents.
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError, AssertionError, OverflowError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{last}: does not hold the state of this agent: {error!r}") from error
    if n_env_steps != reports[-1].n_env_steps:
        raise CheckpointError(
            f"{last}: the agent has taken {n_env_steps} environment steps, but its last epoch reports "
            f"{reports[-1].n_env_steps}"
        )
    return reports


def _facts(report: EpochReport, provenance: CheckpointProvenance | None) -> dict[str, Any]:
    of_epoch = {"n_env_steps": report.n_env_steps, "epoch": report.epoch, **report.evaluation.metrics()}
    return (provenance or CheckpointProvenance()).facts() | of_epoch


def _written(reports: Sequence[EpochReport]) -> str:
    """Return reports as a JSON string, which loads fast from a checkpoint and keeps every digit of a number."""
    return json.dumps(
        [
            {
                **{name: getattr(report, name) for name in ("epoch", "n_env_steps", "wall_s", "metrics", "is_best")},
                "on_plane": report.evaluation.on_plane,
                "episodes": report.evaluation.columns(),
            }
            for report in reports
        ]
    )


def _read(text: Any, path: Path) -> list[EpochReport]:
    try:
        reports = []
        for record in json.loads(text):
            # Checkpoints of earlier versions have no limits.
            evaluation = Evaluation.of_columns(record.pop("episodes"), record.pop("on_plane", ON_PLANE))
            reports.append(EpochReport(**record, evaluation=evaluation))
        # One of them is the best.
        next(report for report in reports if report.is_best)
    except (TypeError, ValueError, KeyError, AttributeError, StopIteration, RecursionError) as error:
        raise CheckpointError(f"{path}: holds no reports of the epochs so far, which resuming needs") from error
    return reports

"""A phase of a study, the search or the final evaluation: what its trials have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial, Trial

from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.space.space import Space
from armscan.sweeps.tasks.attempt import Attempt, trial_folder
from armscan.tracking import TrackingStore, abandon
from armscan.tracking.run import FAILURE_TAG

WORKER_DIED = "its worker died"


@dataclass(frozen=True, kw_only=True)
class Phase:
    """What the trials of one phase have in common.

    Args:
        name: of its study in the storage.
        scheduler: of its trials.
        space: what is searched.
        objectives: names of the metrics that are the trial's values, in order.
        reported: metric that running trials report to the pruner; None without pruning.
        run: runs an attempt at a trial and returns its metrics.
        seeds_of: seeds that a trial is run with.
        sampler: see `StudySettings`.
        seed: of the samplers.
        folder: of the trials.
        artifacts: see `StudySettings`.
        client: of the tracking store.
        experiment_id: of the tracked runs.
        run_id: of the study's tracked run.
    """

    name: str
    scheduler: TrialScheduler
    space: Space
    objectives: tuple[str, ...]
    reported: str | None
    run: Callable[[Attempt], dict[str, float]]
    seeds_of: Callable[[Trial], tuple[int, ...]]
    sampler: Mapping[str, Any]
    seed: int
    folder: Path
    artifacts: Path
    client: TrackingStore
    experiment_id: str
    run_id: str

    def close_runs_of(self, trial: FrozenTrial) -> None:
        """Close the tracked runs that a dead worker has left open, except those that a retry has resumed."""
        abandon(trial_folder(self.folder, trial.number), self.client, WORKER_DIED)

    def close_orphaned_runs(self) -> None:
        """Close runs of failed trials whose workers died before they could write the run's ID to its folder."""
        running = self.client.search_runs(
            [self.experiment_id], f"tags.study = '{self.name}' AND attributes.status = 'RUNNING'"
        )
        state = self.scheduler.state()
        failed = {str(trial.number) for trial in (*state.failed, *state.retried)}
        for run in running:
            if run.data.tags.get("trial") in failed:
                self.client.set_tag(run.info.run_id, FAILURE_TAG, WORKER_DIED)
                self.client.set_terminated(run.info.run_id, "FAILED")

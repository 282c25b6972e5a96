"""A study that is open for work: its phases, the search and the two of the final evaluation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from optuna.trial import FrozenTrial, Trial

from armscan.sweeps.scheduling.population import Population, searched_values
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import CONTROL, retried_by
from armscan.sweeps.space.parameter import Value
from armscan.sweeps.space.space import Space
from armscan.sweeps.storage.attribute_names import FINALIST, RETRY_OF, RUN, SCHEDULE
from armscan.sweeps.study.final_eval import FinalEvaluation
from armscan.sweeps.study.settings import StudySettings
from armscan.sweeps.tasks.attempt import Attempt
from armscan.sweeps.tasks.folders import seed_folders, trial_folder
from armscan.tracking import TrackingStore, fail_dead_runs
from armscan.tracking.tags import FAILURE_TAG, STORAGE_TAG, STUDY_TAG, TRIAL_TAG
from armscan.utils.run_files import LAST_CHECKPOINT

WORKER_DIED = "its worker died"


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A phase of a study: the settings that its trials share.

    Args:
        name: Name of its study in the storage.
        scheduler: Scheduler of its trials.
        space: Search space.
        objectives: Names of the metrics that are a trial's values, in order.
        reported: Names of the metrics that running trials report to the pruner; none without pruning.
        run: Function that runs an attempt at a trial and returns its metrics.
        seeds_of: Function that returns the training seeds of a trial.
        sampler: Sampler; see `StudySettings`.
        seed: Seed of the samplers, combined with a trial's number.
        folder: Folder of the phase.
        artifacts: Folder of the plots; see `StudySettings`.
        store: Tracking store.
        experiment_id: MLflow experiment ID of the tracked runs.
        run_id: MLflow run ID of the study.
        population: Population of which each trial trains a member. Default: None, trials are independent.
        overrides: Overrides of all its trials, in addition to those of the study. Default: none.
    """

    name: str
    scheduler: TrialScheduler
    space: Space
    objectives: tuple[str, ...]
    reported: tuple[str, ...]
    run: Callable[[Attempt], dict[str, float]]
    seeds_of: Callable[[FrozenTrial | Trial], tuple[int, ...]]
    sampler: Mapping[str, Any]
    seed: int
    folder: Path
    artifacts: Path
    store: TrackingStore
    experiment_id: str
    run_id: str
    population: Population | None = None
    overrides: tuple[str, ...] = ()

    def remove_checkpoints(self, finished: FrozenTrial | Trial) -> None:
        """Remove the last checkpoints of a finished trial and of its earlier attempts; the best ones stay.

        In a population, remove the last checkpoints of all trials from which no member can continue any more.
        """
        numbers = {finished.number}
        if RETRY_OF in finished.user_attrs or self.population is not None:
            trials = self.scheduler.study.get_trials(deepcopy=False)
            numbers |= {*retried_by(finished, trials)}
        if self.population is not None:
            numbers = {trial.number for trial in trials} - self.population.checkpoints_to_keep(trials)
        for number in numbers:
            for folder in seed_folders(trial_folder(self.folder, number)):
                (folder / LAST_CHECKPOINT).unlink(missing_ok=True)

    def tags_of(self, trial: FrozenTrial | Trial) -> dict[str, str]:
        """Return the tags that identify the tracked runs of a trial."""
        return {STUDY_TAG: self.name, STORAGE_TAG: self.scheduler.storage.uri, TRIAL_TAG: str(trial.number)}

    def suggest(self, trial: Trial) -> dict[str, Value]:
        """Return the values of a trial by their keys; the control has none."""
        if trial.user_attrs.get(FINALIST) == CONTROL:
            return {}
        chosen = self.space.suggest(trial)
        # A member of a population also has the changes since its beginning.
        return searched_values(trial) if SCHEDULE in trial.user_attrs else chosen

    def close_runs_of(self, trial: FrozenTrial) -> None:
        """Close the tracked runs that a dead worker has left open, except those that a retry has resumed."""
        fail_dead_runs(trial_folder(self.folder, trial.number), self.store, WORKER_DIED)

    def close_orphaned_runs(self) -> None:
        """Close runs whose workers ended before the run's ID was stored in the trial or in the folder of a seed."""
        # Read first: the runs of a trial that finishes meanwhile are closed by its worker.
        finished = self.scheduler.state().finished
        running = self.store.runs(
            [self.experiment_id], f"tags.{STUDY_TAG} = '{self.name}' AND attributes.status = 'RUNNING'"
        )
        state = self.scheduler.state()
        failed = [*state.failed, *state.retried]
        others = [*state.waiting, *finished]
        for run in running:
            run_id, tags = run.info.run_id, run.data.tags.items()
            # A study in another storage may have the same name.
            if any(self.tags_of(trial).items() <= tags for trial in failed):
                self.store.set_tag(run_id, FAILURE_TAG, WORKER_DIED)
                self.store.set_terminated(run_id, "FAILED")
            elif any(self.tags_of(trial).items() <= tags and trial.user_attrs.get(RUN) != run_id for trial in others):
                self.store.set_terminated(run_id, "KILLED")


@dataclass(frozen=True, kw_only=True)
class OpenedStudy:
    """A study that workers can run.

    Args:
        settings: Settings of the study.
        config: Configuration of its trials, without the searched values.
        search: Phase that searches configurations.
        final_eval: Final evaluation; None without one.
        finals: Phases of the final evaluation, which select a configuration and test it; none without one.
    """

    settings: StudySettings
    config: DictConfig
    search: Phase
    final_eval: FinalEvaluation | None
    finals: tuple[Phase, ...]

    @property
    def folder(self) -> Path:
        """The folder of the study."""
        return self.search.folder

    @property
    def phases(self) -> tuple[Phase, ...]:
        """The search, and those of the final evaluation if there is one."""
        return (self.search, *self.finals)

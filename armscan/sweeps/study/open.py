"""A study as its workers and its launcher see it, from the same overrides."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import optuna
from omegaconf import DictConfig
from optuna.trial import FrozenTrial, Trial

from armscan.config.defaults import to_plain
from armscan.sweeps.scheduling.population import Population, searched_values
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import CONTROL, Limits
from armscan.sweeps.scheduling.termination import Termination
from armscan.sweeps.space.parameter import Value
from armscan.sweeps.space.space import Space
from armscan.sweeps.storage.attribute_names import FINALIST, RUN, SCHEDULE, STUDY_RUN
from armscan.sweeps.storage.storage import Storage, open_storage
from armscan.sweeps.study.components import make_terminator
from armscan.sweeps.study.constraints import constrained
from armscan.sweeps.study.dashboard import note_run
from armscan.sweeps.study.final_eval import FinalEvaluation, training_of
from armscan.sweeps.study.population import population_of
from armscan.sweeps.study.settings import StudySettings
from armscan.sweeps.study.study import make_study, name_objectives
from armscan.sweeps.study.warm_start import values_of
from armscan.sweeps.tasks.attempt import Attempt, Task, trial_folder
from armscan.tracking import TrackingStore, abandon, open_store, run_of_study, source
from armscan.tracking.tags import FAILURE_TAG, STORAGE_TAG, STUDY_TAG, TRIAL_TAG
from armscan.utils.files import LAST_CHECKPOINT
from armscan.utils.retry import RETRY_S

NO_END = 10**9
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
        seed: Seed of the samplers, beside a trial's number.
        folder: Folder of its study.
        artifacts: Folder of the plots; see `StudySettings`.
        client: Client of the tracking store.
        experiment_id: MLflow experiment ID of the tracked runs.
        run_id: MLflow run ID of the study.
        population: Population of which each trial trains a member. Default: None, trials are independent.
    """

    name: str
    scheduler: TrialScheduler
    space: Space
    objectives: tuple[str, ...]
    reported: tuple[str, ...]
    run: Callable[[Attempt], dict[str, float]]
    seeds_of: Callable[[Trial], tuple[int, ...]]
    sampler: Mapping[str, Any]
    seed: int
    folder: Path
    artifacts: Path
    client: TrackingStore
    experiment_id: str
    run_id: str
    population: Population | None = None

    def remove_checkpoints(self, finished: Trial) -> None:
        """Remove the last checkpoints of a trial that has finished; the best ones stay.

        Of a population's trials those from which no member can continue any more.
        """
        numbers = {finished.number}
        if self.population is not None:
            trials = self.scheduler.study.get_trials(deepcopy=False)
            numbers = {trial.number for trial in trials} - self.population.checkpoints_to_keep(trials)
        for number in numbers:
            for file in trial_folder(self.folder, number).glob(f"seed_*/{LAST_CHECKPOINT}"):
                file.unlink(missing_ok=True)

    def tags_of(self, trial: FrozenTrial | Trial) -> dict[str, str]:
        """Return the tags by which tracked runs of a trial are known."""
        return {STUDY_TAG: self.name, STORAGE_TAG: self.scheduler.storage.uri, TRIAL_TAG: str(trial.number)}

    def suggest(self, trial: Trial) -> dict[str, Value]:
        """Return the values of a trial by their keys; the control has none."""
        if trial.user_attrs.get(FINALIST) == CONTROL:
            return {}
        chosen = self.space.suggest(trial)
        # Of a member of a population, also what has changed since its beginning.
        return searched_values(trial) if SCHEDULE in trial.user_attrs else chosen

    def close_runs_of(self, trial: FrozenTrial) -> None:
        """Close the tracked runs that a dead worker has left open, except those that a retry has resumed."""
        abandon(trial_folder(self.folder, trial.number), self.client, WORKER_DIED)

    def close_orphaned_runs(self) -> None:
        """Close runs whose workers ended before the trial, or the run's folder, knew the run's ID."""
        running = self.client.runs(
            [self.experiment_id], f"tags.{STUDY_TAG} = '{self.name}' AND attributes.status = 'RUNNING'"
        )
        state = self.scheduler.state()
        failed = [*state.failed, *state.retried]
        for run in running:
            run_id, tags = run.info.run_id, run.data.tags.items()
            # A study in another storage may have the same name.
            if any(self.tags_of(trial).items() <= tags for trial in failed):
                self.client.set_tag(run_id, FAILURE_TAG, WORKER_DIED)
                self.client.set_terminated(run_id, "FAILED")
            elif any(
                self.tags_of(trial).items() <= tags and trial.user_attrs.get(RUN) != run_id for trial in state.waiting
            ):
                self.client.set_terminated(run_id, "KILLED")


@dataclass(frozen=True, kw_only=True)
class OpenedStudy:
    """A study that workers can run.

    Args:
        settings: Settings of the study.
        config: Configuration of its trials, without the searched values.
        search: Phase that searches configurations.
        final_eval: Final evaluation; None without one.
        finals: Phases of the final evaluation, which select a configuration and judge it; none without one.
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


def open_for_work(
    settings: StudySettings, task: Task, config: DictConfig, overrides: Sequence[str], *, retry: bool = False
) -> OpenedStudy:
    """Open a study, and make it if there is none.

    Args:
        settings: Settings of the study, as `read_settings` returns them.
        task: Task of its trials.
        config: Configuration of its trials without the searched values.
        overrides: Overrides that its trials are composed from.
        retry: Whether to wait for a store or a storage that is unavailable. Default: False.

    Raises:
        StudyError: If the storage cannot be used, or the study that exists is another.
        TrackingError: If the tracking store cannot be used.
    """
    retry_s = RETRY_S if retry else None
    client, experiment_id = open_store(**to_plain(config.tracking), retry_s=retry_s)
    for folder in (settings.folder, settings.artifacts):
        Path(folder).mkdir(parents=True, exist_ok=True)
    storage = open_storage(settings.storage, retry=retry)
    study = make_study(storage, settings, to_plain(config))

    @functools.cache
    def create_run() -> str:
        tags = {**source().tags, STUDY_TAG: settings.name, STORAGE_TAG: storage.uri, "overrides": " ".join(overrides)}
        return str(client.create_run(experiment_id, name=f"study {settings.name}", tags=tags).info.run_id)

    def tracked_run() -> str:
        if STUDY_RUN not in study.user_attrs:
            study.set_user_attr(STUDY_RUN, create_run())
            note_run(study, client, experiment_id, create_run(), Path(settings.folder))
            return create_run()
        run = run_of_study(
            client,
            study.user_attrs[STUDY_RUN],
            experiment_id=experiment_id,
            tags={STUDY_TAG: settings.name, TRIAL_TAG: None},
            where=f"{settings.name}.user_attrs.{STUDY_RUN}",
        )
        return str(run.info.run_id)

    objectives = tuple(settings.objectives)
    population = population_of(settings, config)
    plan = None if population is None else lambda: population.plan(study.get_trials(deepcopy=False))
    search = Phase(
        name=settings.name,
        scheduler=TrialScheduler(study, storage, settings, plan, termination=_termination(settings, study, storage)),
        space=settings.space,
        objectives=objectives,
        reported=objectives,
        run=constrained(task.run, settings.constraints),
        seeds_of=lambda _: settings.seeds,
        sampler=settings.sampler,
        seed=settings.seed,
        folder=Path(settings.folder),
        artifacts=Path(settings.artifacts),
        client=client,
        experiment_id=experiment_id,
        run_id=storage.exclusive(tracked_run),
        population=population,
    )
    final_eval = None
    if settings.final_eval.top_k:
        control, misfit = values_of(settings.space, overrides)
        final_eval = FinalEvaluation.opened(storage, settings, study, None if misfit else control)
    finals = _final_phases(search, settings, task, final_eval) if final_eval is not None else ()
    return OpenedStudy(settings=settings, config=config, search=search, final_eval=final_eval, finals=finals)


def _termination(settings: StudySettings, study: optuna.Study, storage: Storage) -> Termination | None:
    if settings.terminator is None:
        return None
    terminator, objectives = make_terminator(settings), list(settings.objectives)
    return Termination(study, storage, lambda state: terminator.reason(study, objectives, state), settings.asked)


def _final_phases(search: Phase, settings: StudySettings, task: Task, final: FinalEvaluation) -> tuple[Phase, Phase]:
    limits = Limits(n_trials=NO_END, max_failures=settings.max_failures, max_retries=settings.max_retries)
    shared = partial(
        dataclasses.replace,
        search,
        reported=(),
        seeds_of=lambda trial: (training_of(trial)[1],),
        population=None,
    )
    storage = search.scheduler.storage
    name_objectives(final.selection, search.objectives)
    name_objectives(final.judgement, [task.final_metric])
    return (
        shared(
            name=final.selection.study_name,
            scheduler=TrialScheduler(final.selection, storage, limits, final.missing_of_selection),
            run=task.validate,
            folder=search.folder / "selection",
        ),
        shared(
            name=final.judgement.study_name,
            scheduler=TrialScheduler(final.judgement, storage, limits, final.missing_of_judgement),
            objectives=(task.final_metric,),
            run=task.evaluate,
            folder=search.folder / "judged",
        ),
    )

"""A study as its workers and its launcher see it: settings, storage, tracked run and phases, from the same words."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import optuna
from omegaconf import DictConfig

from armscan.config.defaults import to_plain
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import Limits
from armscan.sweeps.storage.storage import Storage, open_storage
from armscan.sweeps.study.dashboard import note_run
from armscan.sweeps.study.finalists import final_seed_of
from armscan.sweeps.study.phase import Phase
from armscan.sweeps.study.settings import StudySettings
from armscan.sweeps.study.study import STUDY_RUN, make_study
from armscan.sweeps.tasks.base import Task
from armscan.tracking import TrackingStore, open_store, source_tags
from armscan.utils.retry import RETRY_S

NO_END = 10**9


@dataclass(frozen=True, kw_only=True)
class OpenedStudy:
    """A study that workers can run.

    Args:
        settings: of the study.
        config: of its trials, without the searched values.
        storage: that it is kept in.
        client: of the tracking store.
        run_id: of its own tracked run.
        search: the phase in which configurations are searched.
        final_eval: the phase in which the best are trained with other seeds; None without one.
    """

    settings: StudySettings
    config: DictConfig
    storage: Storage
    client: TrackingStore
    run_id: str
    search: Phase
    final_eval: Phase | None

    @property
    def folder(self) -> Path:
        """Of the study."""
        return Path(self.settings.folder)

    @property
    def phases(self) -> tuple[Phase, ...]:
        """The search, and the final evaluation if there is one."""
        return (self.search,) if self.final_eval is None else (self.search, self.final_eval)


def open_for_work(
    settings: StudySettings, task: Task, config: DictConfig, words: Sequence[str], *, retry: bool = False
) -> OpenedStudy:
    """Open a study, and makes it where there is none.

    Args:
        settings: as `read_settings` returns them.
        task: likewise.
        config: likewise.
        words: that these were read from, without a password.
        retry: see `open_storage`.

    Raises:
        StudyError: if the storage cannot be used, or the study that exists is another.
        TrackingError: if the tracking store cannot be used.
    """
    retry_s = RETRY_S if retry else None
    client, experiment_id = open_store(**to_plain(config.tracking), retry_s=retry_s)
    for folder in (settings.folder, settings.artifacts):
        Path(folder).mkdir(parents=True, exist_ok=True)
    storage = open_storage(settings.storage, retry=retry)
    study = make_study(storage, settings, to_plain(config))

    @functools.cache
    def create_run() -> str:
        tags = {**source_tags(), "study": settings.name, "study.storage": storage.uri, "overrides": " ".join(words)}
        return str(client.create_run(experiment_id, name=f"study {settings.name}", tags=tags).info.run_id)

    def tracked_run() -> str:
        if STUDY_RUN not in study.user_attrs:
            study.set_user_attr(STUDY_RUN, create_run())
            note_run(study, client, experiment_id, create_run(), Path(settings.folder))
        return str(study.user_attrs[STUDY_RUN])

    run_id = storage.exclusive(tracked_run)
    objectives = tuple(settings.objectives)
    search = Phase(
        name=settings.name,
        scheduler=TrialScheduler(study, storage, settings),
        space=settings.space,
        objectives=objectives,
        reported=objectives[0] if len(objectives) == 1 else None,
        run=task.run,
        seeds_of=lambda _: settings.seeds,
        sampler=settings.sampler,
        seed=settings.seed,
        folder=Path(settings.folder),
        artifacts=Path(settings.artifacts),
        client=client,
        experiment_id=experiment_id,
        run_id=run_id,
    )
    return OpenedStudy(
        settings=settings,
        config=config,
        storage=storage,
        client=client,
        run_id=run_id,
        search=search,
        final_eval=_final_phase(search, settings, task, storage) if settings.final_eval.top_k else None,
    )


def _final_phase(search: Phase, settings: StudySettings, task: Task, storage: Storage) -> Phase:
    study = storage.exclusive(
        lambda: optuna.create_study(study_name=settings.final_eval_name, storage=storage.optuna, load_if_exists=True)
    )
    limits = Limits(n_trials=NO_END, max_failures=settings.max_failures, max_retries=settings.max_retries)
    return dataclasses.replace(
        search,
        name=settings.final_eval_name,
        scheduler=TrialScheduler(study, storage, limits, is_open=False),
        objectives=(task.final_metric,),
        reported=None,
        run=task.evaluate,
        seeds_of=final_seed_of,
        folder=search.folder / "judged",
    )

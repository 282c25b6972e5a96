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
from armscan.errors import InvalidValueError, StudyError, listed
from armscan.sweeps.scheduling.scheduler import Limits, TrialScheduler
from armscan.sweeps.storage.storage import Storage, open_storage
from armscan.sweeps.study.arguments import fixed_by
from armscan.sweeps.study.components import make_pruner, make_sampler, make_task
from armscan.sweeps.study.dashboard import note_run
from armscan.sweeps.study.finalists import final_seed_of
from armscan.sweeps.study.phase import Phase
from armscan.sweeps.study.settings import StudySettings
from armscan.sweeps.study.study import STUDY_RUN, make_study
from armscan.sweeps.tasks.attempt import composed, study_section
from armscan.sweeps.tasks.base import Task
from armscan.tracking import TrackingStore, open_store, source_tags
from armscan.utils.retry import RETRY_S

NO_END = 10**9


@dataclass(frozen=True, kw_only=True)
class OpenedStudy:
    """A study that workers can run.

    Args:
        settings: of the study.
        task: what its trials do.
        config: of its trials, without the searched values.
        storage: that it is kept in.
        client: of the tracking store.
        run_id: of its own tracked run.
        search: the phase in which configurations are searched.
        final_eval: the phase in which the best are trained with other seeds; None without one.
    """

    settings: StudySettings
    task: Task
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


def read_settings(words: Sequence[str]) -> tuple[StudySettings, Task, DictConfig]:
    """Return what a command line asks of a study, what a trial does, and its configuration without what it tries.

    Raises:
        InvalidValueError: if something is not allowed.
    """
    section = study_section(words)
    if not section:
        raise InvalidValueError("there is no study in the configuration: give sweep=NAME of a file with one")
    settings = StudySettings.read(section, fixed_by(words))
    # What cannot be made is refused here, and not by the first trial.
    make_sampler(settings.sampler, settings.seed)
    make_pruner(settings.pruner)
    for name in ("folder", "artifacts"):
        check_folder(f"study.{name}", getattr(settings, name))
    task = make_task(settings.task)
    for name in settings.objectives:
        if name not in task.metrics:
            raise InvalidValueError(f"study.objectives names {name!r}, but a trial returns only {listed(task.metrics)}")
    return settings, task, composed(words)[0]


def check_folder(where: str, folder: str) -> None:
    """Raise `StudyError` where something that is no folder is, or stands in the way."""
    path = Path(folder).absolute()
    there = next(each for each in (path, *path.parents) if each.exists())
    if not there.is_dir():
        raise StudyError(f"{where} is {folder!r}, but {str(there)!r} is no folder")


def make_folder(where: str, folder: str) -> None:
    """Make a folder where there is none.

    Raises:
        StudyError: if that cannot be.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StudyError(f"{where} is {folder!r}, but no folder can be made there ({error.strerror})") from error


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
    for name in ("folder", "artifacts"):
        make_folder(f"study.{name}", getattr(settings, name))
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
        scheduler=TrialScheduler(study, storage, settings.limits),
        space=settings.space,
        objectives=objectives,
        reported=objectives[0] if len(objectives) == 1 else None,
        run=task.run,
        seeds_of=lambda _: settings.seeds,
        sampler=settings.sampler,
        seed=settings.seed,
        folder=Path(settings.folder),
        artifacts=Path(settings.artifacts),
        storage_uri=storage.uri,
        client=client,
        experiment_id=experiment_id,
        run_id=run_id,
    )
    return OpenedStudy(
        settings=settings,
        task=task,
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

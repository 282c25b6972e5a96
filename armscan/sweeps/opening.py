"""A study as its workers and its launcher see it: settings, storage, tracked run and phases, from the same words."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import optuna
from omegaconf import DictConfig

from armscan.errors import InvalidValueError, StudyError, listed
from armscan.patience import PATIENCE_S
from armscan.settings import plain
from armscan.sweeps.attempt import composed, study_section
from armscan.sweeps.command_line import fixed_by
from armscan.sweeps.dashboard import note_run
from armscan.sweeps.judging import make_judging_study, seed_of_judged
from armscan.sweeps.ledger import Ledger
from armscan.sweeps.limits import Limits
from armscan.sweeps.parts import make_pruner, make_sampler, make_task
from armscan.sweeps.phases import Phase
from armscan.sweeps.settings import StudySettings
from armscan.sweeps.storage import Storage, open_storage
from armscan.sweeps.study import STUDY_RUN, make_study, open_study
from armscan.sweeps.tasks import Task
from armscan.tracking import TrackingStore, open_store, source_tags

NO_END = 10**9


@dataclass(frozen=True, kw_only=True)
class OpenStudy:
    """A study, ready to be worked at.

    Args:
        settings: what it is asked to do.
        task: what its trials do.
        config: of its trials, without what they try.
        storage: that it is kept in.
        client: of the tracking store.
        experiment_id: of its tracked runs.
        run_id: of its own tracked run.
    """

    settings: StudySettings
    task: Task
    config: DictConfig
    storage: Storage
    client: TrackingStore
    experiment_id: str
    run_id: str

    @property
    def folder(self) -> Path:
        """Of the study."""
        return Path(self.settings.folder)

    def searching(self) -> Phase:
        """The phase in which configurations are searched."""
        settings = self.settings
        limits = Limits(
            n_trials=settings.n_trials,
            max_failures=settings.max_failures,
            max_retries=settings.max_retries,
            hours=settings.hours,
            env_steps=settings.env_steps,
        )
        objectives = tuple(settings.objectives)
        return Phase(
            name=settings.name,
            ledger=Ledger(open_study(self.storage, settings), self.storage, limits),
            space=settings.space,
            objectives=objectives,
            reported=objectives[0] if len(objectives) == 1 else None,
            run=self.task.run,
            seeds_of=lambda _: settings.seeds,
            sampler=settings.sampler,
            seed=settings.seed,
            folder=self.folder,
            artifacts=Path(settings.artifacts),
            storage_uri=self.storage.uri,
            client=self.client,
            experiment_id=self.experiment_id,
            run_id=self.run_id,
        )

    def judging(self) -> Phase:
        """The phase in which the best configurations are judged; begun when the searching is over."""
        searching = self.searching()
        return self._judging(searching, make_judging_study(self.storage, self.settings, searching.ledger.study))

    def judged(self) -> optuna.Study | None:
        """The study of the trainings that judge, None where it has not been begun."""
        name = self.settings.judged_name
        if name not in optuna.get_all_study_names(self.storage.optuna):
            return None
        return optuna.load_study(study_name=name, storage=self.storage.optuna)

    def begun(self) -> list[Phase]:
        """The phases that have been begun."""
        searching, judged = self.searching(), self.judged()
        return [searching, *([] if judged is None else [self._judging(searching, judged)])]

    def _judging(self, searching: Phase, study: optuna.Study) -> Phase:
        limits = Limits(n_trials=NO_END, max_failures=self.settings.max_failures, max_retries=self.settings.max_retries)
        return dataclasses.replace(
            searching,
            name=self.settings.judged_name,
            ledger=Ledger(study, self.storage, limits, is_open=False),
            objectives=(self.task.judged,),
            reported=None,
            run=self.task.judge,
            seeds_of=seed_of_judged,
            folder=self.folder / "judged",
        )


def read_settings(words: Sequence[str]) -> tuple[StudySettings, Task, DictConfig]:
    """Returns what a command line asks of a study, what a trial does, and its configuration without what it tries.

    Raises:
        InvalidValueError: if something is not allowed.
    """
    section = study_section(words)
    if not section:
        raise InvalidValueError("there is no study in the configuration: give sweeps=NAME of a file with one")
    settings = StudySettings.read(section, fixed_by(words))
    # What cannot be made is refused here, and not by the first trial.
    make_sampler(settings.sampler, settings.seed)
    make_pruner(settings.pruner)
    for name in ("folder", "artifacts"):
        check_folder(f"study.{name}", getattr(settings, name))
    task = make_task(settings.task)
    for name in settings.objectives:
        if name not in task.figures:
            raise InvalidValueError(f"study.objectives names {name!r}, but a trial returns only {listed(task.figures)}")
    return settings, task, composed(words)[0]


def check_folder(where: str, folder: str) -> None:
    """Raises `StudyError` where something that is no folder is, or stands in the way."""
    path = Path(folder).absolute()
    there = next(each for each in (path, *path.parents) if each.exists())
    if not there.is_dir():
        raise StudyError(f"{where} is {folder!r}, but {str(there)!r} is no folder")


def make_folder(where: str, folder: str) -> None:
    """Makes a folder where there is none.

    Raises:
        StudyError: if that cannot be.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StudyError(f"{where} is {folder!r}, but no folder can be made there ({error.strerror})") from error


def open_for_work(
    settings: StudySettings, task: Task, config: DictConfig, words: Sequence[str], *, is_patient: bool = False
) -> OpenStudy:
    """Opens a study, and makes it where there is none.

    Args:
        settings: as `read_settings` returns them.
        task: likewise.
        config: likewise.
        words: that these were read from, without a password.
        is_patient: see `open_storage`.

    Raises:
        StudyError: if the storage cannot be used, or the study that exists is another.
        TrackingError: if the tracking store cannot be used.
    """
    patience_s = PATIENCE_S if is_patient else None
    client, experiment_id = open_store(**plain(config.tracking), patience_s=patience_s)
    for name in ("folder", "artifacts"):
        make_folder(f"study.{name}", getattr(settings, name))
    storage = open_storage(settings.storage, is_patient=is_patient)
    study = make_study(storage, settings, plain(config))

    @functools.cache
    def run_made() -> str:
        tags = {**source_tags(), "study": settings.name, "study.storage": storage.uri, "overrides": " ".join(words)}
        return str(client.create_run(experiment_id, name=f"study {settings.name}", tags=tags).info.run_id)

    def tracked() -> str:
        if STUDY_RUN not in study.user_attrs:
            study.set_user_attr(STUDY_RUN, run_made())
            note_run(study, client, experiment_id, run_made(), Path(settings.folder))
        return str(study.user_attrs[STUDY_RUN])

    return OpenStudy(
        settings=settings,
        task=task,
        config=config,
        storage=storage,
        client=client,
        experiment_id=experiment_id,
        run_id=storage.alone(tracked),
    )

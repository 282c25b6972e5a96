"""Open a study from its overrides, in the same way for its workers and its launcher."""

from __future__ import annotations

import dataclasses
import functools
import socket
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from uuid import uuid4

import optuna
from omegaconf import DictConfig

from armscan.config.defaults import to_plain
from armscan.errors import StudyError, printable
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.termination import Termination
from armscan.sweeps.storage.attribute_names import BEGUN_IN, STUDY_RUN
from armscan.sweeps.storage.storage import Storage, open_storage
from armscan.sweeps.study.candidates import training_of
from armscan.sweeps.study.components import EPISODES_KEY, make_as
from armscan.sweeps.study.constraints import constrained
from armscan.sweeps.study.dashboard import note_run
from armscan.sweeps.study.final_eval import FinalEvaluation
from armscan.sweeps.study.final_eval_storage import open_final_eval
from armscan.sweeps.study.fixed_config import fixed_config
from armscan.sweeps.study.phase import OpenedStudy, Phase
from armscan.sweeps.study.population import population_of
from armscan.sweeps.study.settings import StudySettings
from armscan.sweeps.study.study import make_study, name_objectives
from armscan.sweeps.study.terminators import Terminator
from armscan.sweeps.study.warm_start import values_of
from armscan.sweeps.tasks.task import Task
from armscan.tracking import TrackingStore, code_state, open_store, run_of_study
from armscan.tracking.tags import OVERRIDES_TAG, STORAGE_TAG, STUDY_TAG, TRIAL_TAG
from armscan.utils.console import print_sentence
from armscan.utils.files import atomic_write
from armscan.utils.retry import RETRY_S

NO_END = 10**9
# In the folder of a study: its name, and the folder that it was begun in, with a random ID.
OWNER_FILE, ORIGIN_FILE = "study_name", "begun_in"


def open_for_work(
    settings: StudySettings,
    task: Task,
    config: DictConfig,
    overrides: Sequence[str],
    *,
    volumes: Mapping[str, str] | None = None,
    is_worker: bool = False,
) -> OpenedStudy:
    """Open a study; a command creates it if there is none.

    Args:
        settings: Settings of the study, as `read_settings` returns them.
        task: Task of its trials.
        config: Configuration of its trials without the searched values.
        overrides: Overrides that its trials are composed from.
        volumes: Checksums of its volumes; see `volume_sums`. Default: None, they are not compared.
        is_worker: Whether a worker opens it, which waits for a store or a storage that is unavailable, and creates no
            study: one that is gone was deleted. Default: False.

    Raises:
        StudyError: If the storage cannot be used, or the study that exists is another.
        TrackingError: If the tracking store cannot be used.
    """
    retry_s = RETRY_S if is_worker else None
    store, experiment_id = open_store(**to_plain(config.tracking), retry_s=retry_s)
    for folder in (settings.folder, settings.artifacts):
        Path(folder).mkdir(parents=True, exist_ok=True)
    storage = open_storage(settings.storage, retry=is_worker)
    if is_worker and settings.name not in storage.study_names:
        raise StudyError(f"study {settings.name} is not in its storage any more: it was deleted while it ran")
    study = make_study(storage, settings, fixed_config(config, overrides, volumes))
    is_command = volumes is not None
    _claim_folder(Path(settings.folder), study)
    begun_in, is_here = _begun_in(Path(settings.folder), study, storage)
    population = population_of(settings, config)
    if not is_here:
        _check_elsewhere(settings, begun_in, is_population=population is not None, is_command=is_command)
    objectives = tuple(settings.objectives)
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
        store=store,
        experiment_id=experiment_id,
        # Workers do not know the volumes.
        run_id=_tracked_run(
            study, storage, store, experiment_id, Path(settings.folder), overrides, is_command=is_command
        ),
        population=population,
    )
    final_eval = None
    if settings.final_eval.top_k:
        control, misfit = values_of(settings.space, overrides)
        final_eval = open_final_eval(storage, settings, study, None if misfit else control)
    finals = _final_phases(search, settings, task, final_eval) if final_eval is not None else ()
    return OpenedStudy(settings=settings, config=config, search=search, final_eval=final_eval, finals=finals)


def _claim_folder(folder: Path, study: optuna.Study) -> None:
    """Write the name of a study into its folder; raise `StudyError` if another study's files are there."""
    file, name = folder / OWNER_FILE, study.study_name
    if not file.exists():
        # Earlier versions wrote no name.
        is_known = folder.name == name or not (folder / "trials").exists() or bool(study.get_trials(deepcopy=False))
        atomic_write(file, name if is_known else "another study")
    check_owner(folder, name)


def check_owner(folder: Path, name: str) -> None:
    """Raise `StudyError` if the files of another study than `name` are in a folder."""
    file = folder / OWNER_FILE
    if file.exists() and (owner := file.read_text().strip()) != name:
        raise StudyError(
            f"study.folder is {str(folder)!r}, which has the files of {owner}: give study.folder another value"
        )


def _begun_in(folder: Path, study: optuna.Study, storage: Storage) -> tuple[str, bool]:
    """Return the folder that a study was begun in, with its machine, and whether this is it, seen from anywhere."""
    file = folder / ORIGIN_FILE

    def origins() -> tuple[str, str]:
        """Return where the study was begun, and what this folder says."""
        here = file.read_text().strip() if file.exists() else ""
        if BEGUN_IN in study.user_attrs:
            return str(study.user_attrs[BEGUN_IN]), here
        # A study of an earlier version, which has its trials elsewhere or keeps no files of them: nothing is known.
        if study.get_trials(deepcopy=False) and not (folder / "trials").exists():
            return here, here
        here = here or f"{socket.gethostname()}:{folder.absolute()} {uuid4().hex[:8]}"
        atomic_write(file, f"{here}\n")
        study.set_user_attr(BEGUN_IN, here)
        return here, here

    of_study, of_folder = storage.exclusive(origins)
    # The ID is what counts: machines may see the folder by other paths, or under the same path another folder.
    return of_study.rpartition(" ")[0], of_study == of_folder


def _check_elsewhere(settings: StudySettings, begun_in: str, *, is_population: bool, is_command: bool) -> None:
    """Refuse a folder without the checkpoints that a population copies; for other studies, print what it means."""
    where = (
        f"study.folder is {settings.folder!r}, but the study {settings.name} was begun in {begun_in}, and its "
        "files are not here"
    )
    if is_population:
        raise StudyError(f"{where}: its members copy checkpoints of others, so type the command there")
    if is_command:
        print_sentence(printable(f"note: {where}: trials that were interrupted in the other folder begin anew"))


def _tracked_run(
    study: optuna.Study,
    storage: Storage,
    store: TrackingStore,
    experiment_id: str,
    folder: Path,
    overrides: Sequence[str],
    *,
    is_command: bool,
) -> str:
    """Return the ID of a study's own run in MLflow, which shows the overrides of the latest command.

    Create the run if the study has none yet.
    """
    name, typed = study.study_name, " ".join(overrides)

    @functools.cache
    def create_run() -> str:
        tags = {**code_state().tags, STUDY_TAG: name, STORAGE_TAG: storage.uri, OVERRIDES_TAG: typed}
        return str(store.create_run(experiment_id, name=f"study {name}", tags=tags).info.run_id)

    def tracked_run() -> str:
        if STUDY_RUN not in study.user_attrs:
            study.set_user_attr(STUDY_RUN, create_run())
            note_run(study, store, experiment_id, create_run(), folder)
            return create_run()
        run = run_of_study(
            store,
            study.user_attrs[STUDY_RUN],
            experiment_id=experiment_id,
            tags={STUDY_TAG: name, TRIAL_TAG: None},
            where=f"{name}.user_attrs.{STUDY_RUN}",
        )
        if is_command and run.data.tags.get(OVERRIDES_TAG) != typed:
            store.set_tag(run.info.run_id, OVERRIDES_TAG, typed)
        return str(run.info.run_id)

    return storage.exclusive(tracked_run)


def _termination(settings: StudySettings, study: optuna.Study, storage: Storage) -> Termination | None:
    if settings.terminator is None:
        return None
    terminator: Terminator = make_as("terminator", settings.terminator, Terminator)
    objectives = list(settings.objectives)
    return Termination(study, storage, lambda state: terminator.reason(study, objectives, state), settings.asked)


def _final_phases(search: Phase, settings: StudySettings, task: Task, final: FinalEvaluation) -> tuple[Phase, Phase]:
    limits = Limits(n_trials=NO_END, max_failures=settings.max_failures, max_retries=settings.max_retries)
    shared = partial(
        dataclasses.replace,
        search,
        reported=(),
        seeds_of=lambda trial: (training_of(trial)[1],),
        population=None,
        overrides=() if (n := settings.final_eval.episodes) is None else (f"{EPISODES_KEY}={n}",),
    )
    scheduler = partial(TrialScheduler, storage=search.scheduler.storage, limits=limits, is_current=final.is_current)
    name_objectives(final.selection, search.objectives)
    name_objectives(final.test, [task.final_metric])
    return (
        shared(
            name=final.selection.study_name,
            scheduler=scheduler(final.selection, plan=final.missing_of_selection, unwanted=final.unwanted_of_selection),
            run=task.validate,
            folder=search.folder / "selection",
        ),
        shared(
            name=final.test.study_name,
            scheduler=scheduler(final.test, plan=final.missing_of_test, unwanted=final.unwanted_of_test),
            objectives=(task.final_metric,),
            run=task.evaluate,
            folder=search.folder / "judged",
        ),
    )

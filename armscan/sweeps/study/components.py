"""Components of a study: its settings, task, sampler and pruner, and whether its space can be built."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import optuna
from hydra.errors import HydraException, InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from optuna.pruners import BasePruner
from optuna.samplers import BaseSampler

from armscan.config.compose import compose, compose_run, reduce_to_run
from armscan.config.defaults import to_plain
from armscan.config.error_messages import one_line_message
from armscan.config.sources import SWEEP
from armscan.errors import ArmscanError, InvalidValueError, StudyError, listed, reason_of
from armscan.sweeps.scheduling.state import TEST_PREFIX
from armscan.sweeps.space.parameter import Value, overrides_of
from armscan.sweeps.space.space import Space
from armscan.sweeps.study.arguments import TRAINING_TASK, fixed_by
from armscan.sweeps.study.samplers import CmaEsSampler
from armscan.sweeps.study.settings import FinalEvalSettings, StudySettings
from armscan.sweeps.study.task_check import check_objectives, check_same_task
from armscan.sweeps.study.terminators import Terminator
from armscan.sweeps.tasks.task import Task
from armscan.training.metric_display import bounds_of
from armscan.utils.files import nearest_existing
from armscan.utils.validation import missing_members

EPISODES_KEY = "evaluation.episodes"


def read_settings(overrides: Sequence[str]) -> tuple[StudySettings, Task, DictConfig]:
    """Return a study's settings from its command line, the task, and the configuration without searched values."""
    config = compose(overrides, return_hydra_config=True)
    if config.get(SWEEP) is not None:
        raise InvalidValueError(
            f"the file that {SWEEP}= names sets only the section {SWEEP} of the configuration: its first line must be "
            "'# @package _global_'"
        )
    section = to_plain(config.study) if config.get("study") is not None else {}
    # The command sets it for each worker.
    section.pop("worker", None)
    if not section:
        raise InvalidValueError("there is no study in the configuration: give sweep=NAME of a file with one")
    if "space" in section:
        # A key that is given a value is not searched.
        section["space"] = Space.read(section["space"]).without(fixed_by(overrides))
        if not section["space"].parameters:
            raise InvalidValueError("nothing is left to search: each key of study.space is given a value")
    settings = StudySettings.read("study", section)
    # A component that cannot be instantiated is refused here, and not by the first trial.
    sampler = make("sampler", settings.sampler, BaseSampler, seed=settings.seed)
    if isinstance(sampler, optuna.samplers.CmaEsSampler) and not isinstance(sampler, CmaEsSampler):
        raise InvalidValueError(
            f"study.sampler is {settings.sampler['_target_']}, which executes what the storage of the study holds: "
            "give study/sampler=cmaes"
        )
    if isinstance(sampler, CmaEsSampler) and len(settings.objectives) > 1:
        raise InvalidValueError(
            f"study.sampler is cmaes, which searches for one objective, but study.objectives has "
            f"{len(settings.objectives)}: give study/sampler=tpe"
        )
    make("pruner", settings.pruner, BasePruner)
    if settings.terminator is not None:
        n_trials = None if settings.warm_start else settings.n_trials
        make_as("terminator", settings.terminator, Terminator).check(
            len(settings.objectives), len(settings.seeds), n_trials
        )
    for name, folder in (("folder", settings.folder), ("artifacts", settings.artifacts)):
        if not (there := nearest_existing(Path(folder))).is_dir():
            raise StudyError(f"study.{name} is {folder!r}, but {str(there)!r} is not a folder")
    of_trials, _ = reduce_to_run(config)
    return settings, _task_of(settings, of_trials), of_trials


def _task_of(settings: StudySettings, config: DictConfig) -> Task:
    """Return the task of a study, which returns its objectives and the metrics of its constraints."""
    task: Task = make_as("task", settings.task, Task)
    if not str(task.final_metric).startswith(TEST_PREFIX):
        raise InvalidValueError(
            f"study.task is {settings.task['_target_']}, whose final_metric is {task.final_metric!r}, but it must "
            f"begin with {TEST_PREFIX}, as all metrics that its evaluate returns"
        )
    _check_returned(settings, task, config)
    return task


def _check_returned(settings: StudySettings, task: Task, config: DictConfig) -> None:
    """Check that a trial with a configuration returns what objectives and constraints name."""
    returned = task.metrics(config)
    for name in settings.objectives:
        if name not in returned:
            raise InvalidValueError(
                f"study.objectives names {name!r}, but a trial of this configuration returns only {listed(returned)}"
            )
    for constraint in settings.constraints:
        if constraint.metric not in returned:
            raise InvalidValueError(
                f"study.constraints has '{constraint}', but a trial returns only {listed(returned)}"
            )
        low, high = bounds_of(constraint.metric)
        if constraint.bound < low if constraint.is_upper else constraint.bound > high:
            allowed = f"at least {low:g}" if math.isinf(high) else f"from {low:g} to {high:g}"
            raise InvalidValueError(
                f"study.constraints has '{constraint}', which no trial can satisfy: {constraint.metric} is {allowed}"
            )


def make(name: str, described: Mapping[str, Any], kind: type[Any], **arguments: Any) -> Any:
    """Return the object of Optuna's class `kind` that `study.NAME` describes.

    Raises:
        InvalidValueError: If it describes none.
    """
    made = _made(name, described, **arguments)
    if not isinstance(made, kind):
        raise InvalidValueError(f"study.{name} is {described['_target_']}, but it must be a {name} of Optuna")
    return made


def make_as(name: str, described: Mapping[str, Any], protocol: type[Any]) -> Any:
    """Return the object that `study.NAME` describes, which has all members of a protocol.

    Raises:
        InvalidValueError: If it has not.
    """
    made = _made(name, described)
    if missing := missing_members(made, protocol):
        raise InvalidValueError(f"study.{name} is {described['_target_']}, which has no {missing[0]}, as a {name} must")
    return made


def _made(name: str, described: Mapping[str, Any], **arguments: Any) -> object:
    try:
        return instantiate(described, **arguments)
    except InstantiationException as error:
        raise InvalidValueError(f"study.{name} cannot be made: {reason_of(error.__cause__ or error)}") from error


def check_space(settings: StudySettings, task: Task, overrides: Sequence[str], config: DictConfig) -> None:
    """Check the configuration without the space, then with each choice and both ends of each range.

    Choices of groups and of top-level keys are also checked with values of all other parameters, as in a trial.

    Args:
        settings: Settings of the study.
        task: Task of its trials, which checks each configuration.
        overrides: Overrides that its trials are composed from.
        config: Configuration of its trials without the searched values.

    Raises:
        InvalidValueError: If a key is unknown, a value not allowed, or trials would not compare.
    """
    tried = list(settings.space.extremes())
    # Groups and top-level keys: another choice may remove keys that other parameters set.
    whole = [chosen for chosen in tried if "." not in list(chosen)[-1]]
    for chosen in whole:
        # Before an agent is built, because the first agent of a process compiles for many seconds.
        with _named(chosen):
            compose_run([*overrides, *overrides_of(chosen)])
    task.check(config)
    trains = settings.task["_target_"] == TRAINING_TASK
    if trains:
        check_objectives(settings.objectives, config)
    _check_final_episodes(settings.final_eval, OmegaConf.select(config, EPISODES_KEY))
    for chosen in (*tried, *map(settings.space.completed, whole)):
        with _named(chosen):
            of_trial, _ = compose_run([*overrides, *overrides_of(chosen)])
            task.check(of_trial)
            _check_returned(settings, task, of_trial)
            if trains:
                check_objectives(settings.objectives, of_trial)
                check_same_task([*settings.objectives], config, of_trial)


def _check_final_episodes(final: FinalEvalSettings, n_of_trials: int | None) -> None:
    """Check that final trainings have as many episodes as trials, or more."""
    if not final.top_k or final.episodes is None:
        return
    if n_of_trials is None:
        raise InvalidValueError(
            f"study.final_eval.episodes is {final.episodes}, but the configuration has no {EPISODES_KEY}: give "
            "study.final_eval.episodes=null"
        )
    if n_of_trials > final.episodes:
        raise InvalidValueError(
            f"{EPISODES_KEY} is {n_of_trials}, but final trainings must have at least as many: give also "
            f"study.final_eval.episodes, which is {final.episodes}"
        )


@contextmanager
def _named(chosen: Mapping[str, Value]) -> Iterator[None]:
    """Name the tried values in the error that they lead to."""
    try:
        yield
    except (ArmscanError, HydraException, OmegaConfBaseException, ValueError) as error:
        line = one_line_message(error) or str(error)
        raise InvalidValueError(f"study.space: {' '.join(overrides_of(chosen))} is not allowed: {line}") from error

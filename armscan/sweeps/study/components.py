"""What a study's configuration names: its settings, task, sampler and pruner, and whether its space can be built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.errors import HydraException, InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from optuna.pruners import BasePruner
from optuna.samplers import BaseSampler

from armscan.config.error_messages import one_line_message
from armscan.errors import ArmscanError, InvalidValueError, StudyError, listed
from armscan.sweeps.space.overrides import overrides_of
from armscan.sweeps.space.space import Space
from armscan.sweeps.study.arguments import fixed_by
from armscan.sweeps.study.settings import StudySettings
from armscan.sweeps.tasks.attempt import composed, study_section
from armscan.sweeps.tasks.base import Task

TASK_MEMBERS = ("metrics", "final_metric", "check", "run", "evaluate")


def read_settings(words: Sequence[str]) -> tuple[StudySettings, Task, DictConfig]:
    """Return what a command line asks of a study, what a trial does, and its configuration without what it tries.

    Raises:
        InvalidValueError: if something is not allowed.
    """
    # The command sets `worker` for each worker.
    section = {key: value for key, value in study_section(words).items() if key != "worker"}
    if not section:
        raise InvalidValueError("there is no study in the configuration: give sweep=NAME of a file with one")
    if "space" in section:
        # What is given a value is not searched.
        section["space"] = Space.read(section["space"]).without(fixed_by(words))
        if not section["space"].parameters:
            raise InvalidValueError("nothing is left to search: each key of study.space is given a value")
    settings = StudySettings.read("study", section)
    # What cannot be made is refused here, and not by the first trial.
    make_sampler(settings.sampler, settings.seed)
    make_pruner(settings.pruner)
    for name, folder in (("folder", settings.folder), ("artifacts", settings.artifacts)):
        path = Path(folder).absolute()
        there = next(each for each in (path, *path.parents) if each.exists())
        if not there.is_dir():
            raise StudyError(f"study.{name} is {folder!r}, but {str(there)!r} is no folder")
    task: Task = _made("task", settings.task)
    if missing := [name for name in TASK_MEMBERS if not hasattr(task, name)]:
        raise InvalidValueError(f"study.task is {settings.task['_target_']}, which has no {missing[0]}, as a task must")
    for name in settings.objectives:
        if name not in task.metrics:
            raise InvalidValueError(f"study.objectives names {name!r}, but a trial returns only {listed(task.metrics)}")
    return settings, task, composed(words)[0]


def make_sampler(described: Mapping[str, Any], seed: int) -> BaseSampler:
    """Return an Optuna sampler; raises `InvalidValueError` if `study.sampler` describes none."""
    sampler = _made("sampler", described, seed=seed)
    if not isinstance(sampler, BaseSampler):
        raise InvalidValueError(f"study.sampler is {described['_target_']}, but it must be a sampler of Optuna")
    return sampler


def make_pruner(described: Mapping[str, Any]) -> BasePruner:
    """Return an Optuna pruner; raises `InvalidValueError` if `study.pruner` describes none."""
    pruner = _made("pruner", described)
    if not isinstance(pruner, BasePruner):
        raise InvalidValueError(f"study.pruner is {described['_target_']}, but it must be a pruner of Optuna")
    return pruner


def _made(name: str, described: Mapping[str, Any], **arguments: Any) -> Any:
    try:
        return instantiate(described, **arguments)
    except InstantiationException as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise InvalidValueError(f"study.{name} cannot be made: {reason}") from error


def check_space(settings: StudySettings, task: Task, words: Sequence[str], config: DictConfig) -> None:
    """Build what is run as it is without the space, then with each choice and both ends of each range.

    Choices of groups and of keys at the top are tried beside values of all others, too, as a trial has them.

    Args:
        settings: those of the study.
        task: what its trials do.
        words: those of the command line.
        config: the configuration that they are composed to.

    Raises:
        InvalidValueError: if a key is unknown, or a value not allowed.
    """
    task.check(config)
    tried = list(settings.space.extremes())
    # What one of them changes, the last, may leave no place for another.
    tried += [settings.space.completed(chosen) for chosen in tried if "." not in list(chosen)[-1]]
    for chosen in tried:
        overrides = overrides_of(chosen)
        try:
            task.check(composed([*words, *overrides])[0])
        except (ArmscanError, HydraException, OmegaConfBaseException, ValueError) as error:
            line = one_line_message(error) or str(error)
            raise InvalidValueError(f"study.space: {' '.join(overrides)} is not allowed: {line}") from error

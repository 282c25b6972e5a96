"""What a study's configuration names by class: the task of its trials, its sampler and its pruner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import get_class, instantiate
from optuna.pruners import BasePruner
from optuna.samplers import BaseSampler

from armscan.errors import InvalidValueError
from armscan.sweeps.tasks.base import Task

TASK_MEMBERS = ("metrics", "final_metric", "check", "run", "evaluate")


def make_task(described: Mapping[str, Any]) -> Task:
    """Return what the trials of a study do.

    Raises:
        InvalidValueError: if `study.task` does not describe it.
    """
    task: Task = _made("study.task", described)
    if missing := [name for name in TASK_MEMBERS if not hasattr(task, name)]:
        raise InvalidValueError(f"study.task is {described['_target_']}, which has no {missing[0]}, but a task must")
    return task


def make_sampler(described: Mapping[str, Any], seed: int) -> BaseSampler:
    """Return an Optuna sampler.

    Raises:
        InvalidValueError: if `study.sampler` describes none.
    """
    sampler = _made("study.sampler", described, seed=seed)
    if not isinstance(sampler, BaseSampler):
        raise InvalidValueError(f"study.sampler is {described['_target_']}, but it must be a sampler of Optuna")
    return sampler


def make_pruner(described: Mapping[str, Any]) -> BasePruner:
    """Return an Optuna pruner.

    Raises:
        InvalidValueError: if `study.pruner` describes none.
    """
    pruner = _made("study.pruner", described)
    if not isinstance(pruner, BasePruner):
        raise InvalidValueError(f"study.pruner is {described['_target_']}, but it must be a pruner of Optuna")
    return pruner


def _made(where: str, described: Mapping[str, Any], **arguments: Any) -> Any:
    name = described["_target_"]
    try:
        get_class(name)
    except (ImportError, ValueError, InstantiationException) as error:
        reason = " ".join(str(error).split())
        raise InvalidValueError(f"{where}._target_ is {name!r}, but there is no such class: {reason}") from error
    try:
        return instantiate(described, **arguments)
    except InstantiationException as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise InvalidValueError(f"{where} cannot be made: {reason}") from error

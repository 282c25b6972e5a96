"""The population of a study, as its section of the configuration describes it."""

from __future__ import annotations

from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig
from optuna.samplers import BaseSampler

from armscan.agents.hyperparameters import round_up
from armscan.agents.schedule import AGENT
from armscan.errors import InvalidValueError, few, listed
from armscan.sweeps.scheduling.population import Population, PopulationSampler
from armscan.sweeps.study.components import make, make_as
from armscan.sweeps.study.settings import NO_PRUNER, StudySettings
from armscan.sweeps.tasks.task import Task
from armscan.sweeps.tasks.training import TrainingTask
from armscan.utils.validation import check_int

WITH = "population-based training (study/sampler=pbt) requires"


def population_of(settings: StudySettings, config: DictConfig) -> Population | None:
    """Return the population of a study; None if its trials are independent.

    Args:
        settings: Settings of the study.
        config: Configuration of its trials, without the searched values.

    Raises:
        InvalidValueError: If the study has a setting that a population does not support.
    """
    sampler = make("sampler", settings.sampler, BaseSampler, seed=settings.seed)
    if not isinstance(sampler, PopulationSampler):
        return None
    _check(settings, config, sampler)
    (direction,) = settings.objectives.values()
    total = config.training.env_steps
    population = Population(sampler, settings.space, total, direction == "maximize", settings.seed)
    if settings.n_trials != population.n_trials:
        raise InvalidValueError(
            f"study.n_trials is {settings.n_trials}, but {sampler.population} members with {population.n_generations} "
            f"generations (training.env_steps / study.sampler.interval_env_steps) are {population.n_trials} trials: "
            f"give study.n_trials={population.n_trials}"
        )
    return population


def _check(settings: StudySettings, config: DictConfig, sampler: PopulationSampler) -> None:
    if settings.pruner["_target_"] != NO_PRUNER:
        raise InvalidValueError(f"{WITH} study/pruner=none: the worst members continue from the best")
    if len(settings.objectives) > 1:
        raise InvalidValueError(f"{WITH} one objective, but study.objectives has {len(settings.objectives)}")
    if not isinstance(make_as("task", settings.task, Task), TrainingTask):
        raise InvalidValueError(f"{WITH} a task that trains agents, but study.task is {settings.task['_target_']}")
    for key in ("constraints", "warm_start", "enqueue"):
        if getattr(settings, key):
            raise InvalidValueError(f"{WITH} study.{key}=[]")
    if settings.terminator is not None:
        raise InvalidValueError(f"{WITH} no study/terminator")
    for key in ("solved", "schedule"):
        if config.training.get(key) is not None:
            raise InvalidValueError(f"{WITH} training.{key}=null")
    algorithm = instantiate(config.agent)
    _check_interval(config, algorithm, sampler.interval_env_steps)
    allowed = [f"{AGENT}{name}" for name in getattr(algorithm, "SCHEDULABLE", ())]
    for parameter in settings.space.parameters:
        if parameter.name not in allowed:
            raise InvalidValueError(
                f"study.space has {parameter.name}, but during a training only this can change: {listed(allowed)}"
            )
        if parameter.when:
            raise InvalidValueError(f"study.space.{parameter.name}.when: {WITH} keys that are always searched")


def _check_interval(config: DictConfig, algorithm: Any, interval: int) -> None:
    """Raise `InvalidValueError` if generations do not divide the training, or one of them would have no epoch."""
    total, name = config.training.env_steps, "study.sampler.interval_env_steps"
    if total % interval or total == interval:
        raise InvalidValueError(
            f"{name} is {interval}, but it must divide training.env_steps = {total} into two generations or more"
        )
    epoch = check_int("training.eval_every_env_steps", config.training.eval_every_env_steps, at_least=1)
    starts = _epoch_starts(algorithm, total, epoch)
    longer = [total // n for n in range(total // interval, 1, -1) if total % n == 0]
    fitting = [each for each in longer if len({start // each for start in starts}) == total // each]
    if interval not in fitting:
        raise InvalidValueError(
            f"{name} is {interval}, but an epoch must begin in each generation, and they begin at the environment "
            f"steps {few(starts)} (training.eval_every_env_steps in whole collections, agent.learning_starts): give "
            + (f"{name}={fitting[0]}" if fitting else "a smaller training.eval_every_env_steps")
        )


def _epoch_starts(algorithm: Any, total: int, epoch: int) -> list[int]:
    """Return the environment steps at which the epochs of a training begin.

    Args:
        algorithm: Algorithm, whose collections are never cut short.
        total: Environment steps of the training.
        epoch: Environment steps of an epoch, as configured.
    """
    # A plane finder plays whole episodes.
    at_once = getattr(algorithm, "num_envs", 1) * getattr(algorithm, "n_looks", 1)
    collection = round_up(getattr(algorithm, "env_steps_per_collection", 1), at_once)
    starts = [round_up(getattr(algorithm, "learning_starts", 0), at_once)]
    while (start := starts[-1] + round_up(min(epoch, total - starts[-1]), collection)) < total:
        starts.append(start)
    return starts

"""The population of a study, as its section of the configuration describes it."""

from __future__ import annotations

from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig
from optuna.samplers import BaseSampler

from armscan.agents.schedule import AGENT
from armscan.errors import InvalidValueError, listed
from armscan.sweeps.scheduling.population import Population, PopulationSampler
from armscan.sweeps.study.components import make
from armscan.sweeps.study.settings import NO_PRUNER, StudySettings
from armscan.sweeps.tasks.training import TrainingTask

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
    if not isinstance(make("task", settings.task, object), TrainingTask):
        raise InvalidValueError(f"{WITH} a task that trains agents, but study.task is {settings.task['_target_']}")
    for key in ("constraints", "warm_start", "enqueue"):
        if getattr(settings, key):
            raise InvalidValueError(f"{WITH} study.{key}=[]")
    if settings.terminator is not None:
        raise InvalidValueError(f"{WITH} no study/terminator")
    for key in ("solved", "schedule"):
        if config.training.get(key) is not None:
            raise InvalidValueError(f"{WITH} training.{key}=null")
    _check_interval(config, sampler.interval_env_steps)
    allowed = [f"{AGENT}{name}" for name in getattr(instantiate(config.agent), "SCHEDULABLE", ())]
    for parameter in settings.space.parameters:
        if parameter.name not in allowed:
            raise InvalidValueError(
                f"study.space has {parameter.name}, but during a training only this can change: {listed(allowed)}"
            )
        if parameter.when:
            raise InvalidValueError(f"study.space.{parameter.name}.when: {WITH} keys that are always searched")


def _check_interval(config: DictConfig, interval: int) -> None:
    """Raise `InvalidValueError` if generations do not divide the training, or one of them could have no epoch."""
    total, epoch = config.training.env_steps, config.training.eval_every_env_steps
    name = "study.sampler.interval_env_steps"
    if total % interval or total == interval:
        raise InvalidValueError(
            f"{name} is {interval}, but it must divide training.env_steps = {total} into two generations or more"
        )
    agent: Any = config.agent
    # An epoch has whole collections, and the first one also the steps before learning starts.
    epoch = max(epoch, agent.get("env_steps_per_collection", 1))
    first = agent.get("learning_starts", 0) + epoch
    if interval < epoch or 2 * interval <= first:
        raise InvalidValueError(
            f"{name} is {interval}, but it must be at least {max(epoch, first // 2 + 1)}, so that each generation has "
            "an epoch (training.eval_every_env_steps, agent.learning_starts)"
        )

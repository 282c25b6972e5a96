"""What a study is asked to do: the section `study` of the configuration, checked."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from armscan.checks import LARGEST_SEED, check_bool, check_float, check_int, check_ints, check_seed
from armscan.errors import InvalidValueError, listed
from armscan.sweeps.space import Space

NAME, MAX_NAME_CHARS = re.compile(r"\w[\w\-.]*"), 100
# What follows the name of a study in that of the study of the trainings that judge it.
JUDGED_SUFFIX = "-judged"
# A seed that judges is this much above all those that choose.
FIRST_SEED_ABOVE, MAX_JUDGING_SEEDS = 1000, 1000
# For the command: which worker it is.
NOT_READ = ("worker",)
DIRECTIONS, NO_PRUNER = ("minimize", "maximize"), "optuna.pruners.NopPruner"


@dataclass(frozen=True, kw_only=True)
class Judging:
    """How the best configurations are judged when the study is done.

    Args:
        best: how many of them; 0 for none.
        seeds: how many trainings of each, none of them with a seed that it was chosen by.
    """

    best: int
    seeds: int

    @classmethod
    def read(cls, section: Any) -> Self:
        """Returns what a section of the configuration says."""
        if not isinstance(section, Mapping) or section.keys() != {"best", "seeds"}:
            raise InvalidValueError(f"study.judging is {section!r}, but it must have best and seeds")
        return cls(**section)

    def __post_init__(self) -> None:
        check_int("study.judging.best", self.best, at_least=0)
        check_int("study.judging.seeds", self.seeds, at_least=1, at_most=MAX_JUDGING_SEEDS)


@dataclass(frozen=True, kw_only=True)
class StudySettings:
    """What a study is asked to do.

    Args:
        name: of the study, in its storage and of its folder.
        storage: where it is kept, as `open_storage` takes it.
        folder: of its trials.
        artifacts: folder of the pictures for Optuna's dashboard.
        task: what makes a `Task`, as Hydra would instantiate it.
        space: what is searched.
        objectives: direction by the name of each figure.
        sampler: what makes an Optuna sampler of a seed, as Hydra would instantiate it.
        pruner: an Optuna pruner, likewise.
        prune_after_env_steps: of each trial, before it may be pruned.
        n_trials: that are to finish.
        max_failures: trials that may raise or die for good before the study ends.
        max_retries: how often a trial is taken up again whose worker died.
        hours: wall time in which trials run, for the whole study; None for no limit.
        env_steps: of all trials together; None for no limit.
        workers: trials at a time, of this start.
        seed: of the samplers.
        seeds: that each trial is run with, one after another.
        judging: of the best at the end.
        accept_changes: whether to go on although the fixed configuration has changed.
        plan: whether only to show what would be run.
    """

    name: str
    storage: str
    folder: str
    artifacts: str
    task: Mapping[str, Any]
    space: Space
    objectives: Mapping[str, str]
    sampler: Mapping[str, Any]
    pruner: Mapping[str, Any]
    prune_after_env_steps: int
    n_trials: int
    max_failures: int
    max_retries: int
    hours: float | None
    env_steps: int | None
    workers: int
    seed: int
    seeds: tuple[int, ...]
    judging: Judging
    accept_changes: bool
    plan: bool = False

    @classmethod
    def read(cls, section: Mapping[str, Any], fixed: Mapping[str, Any]) -> Self:
        """Returns the settings of a configuration's section.

        Args:
            section: with plain values.
            fixed: keys of the configuration that somebody gave a value, which are not searched.

        Raises:
            InvalidValueError: if a key is unknown, missing or has a value that is not allowed.
        """
        known = {*cls.__dataclass_fields__, *NOT_READ}
        if unknown := [key for key in section if key not in known]:
            raise InvalidValueError(f"there is no key {unknown[0]!r} in study, but only {listed(sorted(known))}")
        values = {key: value for key, value in section.items() if key not in NOT_READ}
        if missing := [key for key in cls.__dataclass_fields__ if key not in values]:
            raise InvalidValueError(f"study.{missing[0]} is not set, but it must be")
        judging = Judging.read(values["judging"])
        space = Space.read(values["space"]).without(fixed)
        if not space.parameters:
            raise InvalidValueError("nothing is left to search: each key of study.space is given a value")
        read = {
            "space": space,
            "judging": judging,
            "seeds": _seeds(values["seeds"], LARGEST_SEED - FIRST_SEED_ABOVE - judging.seeds),
            "objectives": _objectives(values["objectives"]),
        }
        return cls(**values | read)

    def __post_init__(self) -> None:
        check_study_name("study.name", self.name)
        for name in ("storage", "folder", "artifacts"):
            if not isinstance(given := getattr(self, name), str) or not given.strip() or "\0" in given:
                raise InvalidValueError(f"study.{name} is {given!r}, but it must be a text that says where")
        for name, made in (("task", self.task), ("sampler", self.sampler), ("pruner", self.pruner)):
            if not isinstance(made, Mapping) or "." not in str(made.get("_target_")):
                raise InvalidValueError(f"study.{name} is {made!r}, but it must have a _target_, the name of a class")
        if len(self.objectives) > 1 and self.pruner["_target_"] != NO_PRUNER:
            raise InvalidValueError(
                f"study.pruner is {self.pruner['_target_']}, but trials of several objectives cannot be pruned: give "
                "study/pruner=none"
            )
        check_int("study.prune_after_env_steps", self.prune_after_env_steps, at_least=1)
        check_int("study.n_trials", self.n_trials, at_least=1)
        check_int("study.max_failures", self.max_failures, at_least=0)
        check_int("study.max_retries", self.max_retries, at_least=0)
        check_seed("study.seed", self.seed)
        check_int("study.workers", self.workers, at_least=1)
        if self.hours is not None:
            check_float("study.hours", self.hours, above=0.0)
        if self.env_steps is not None:
            check_int("study.env_steps", self.env_steps, at_least=1)
        check_bool("study.accept_changes", self.accept_changes)
        check_bool("study.plan", self.plan)

    @property
    def judged_name(self) -> str:
        """The name of the study of the trainings that judge."""
        return self.name + JUDGED_SUFFIX

    def check_workers(self, n_cores: int) -> None:
        """Raises `InvalidValueError` where the workers' compute threads would be more than the cores of one machine."""
        n_threads = int(os.environ.get("OMP_NUM_THREADS", "1"))
        if self.workers * n_threads > n_cores:
            each = "" if n_threads == 1 else f" of {n_threads} compute threads each (OMP_NUM_THREADS)"
            raise InvalidValueError(
                f"study.workers is {self.workers}{each}, but this machine has {n_cores} cores: give at most "
                f"{max(1, n_cores // n_threads)}"
            )


def check_study_name(where: str, name: Any) -> str:
    """Returns the name of a study, if it is one."""
    if not isinstance(name, str) or not NAME.fullmatch(name) or len(name) > MAX_NAME_CHARS:
        raise InvalidValueError(
            f"{where} is {name!r}, but it must begin with a letter, a digit or _, go on with these, - and ., and have "
            f"at most {MAX_NAME_CHARS} characters"
        )
    if name.endswith(JUDGED_SUFFIX):
        raise InvalidValueError(f"{where} is {name!r}, but {JUDGED_SUFFIX} at its end is for the trainings that judge")
    return name


def _objectives(objectives: Any) -> dict[str, str]:
    """Returns the direction of each figure, of texts such as `minimize mean_steps`."""
    pairs = [str(each).split() for each in objectives] if isinstance(objectives, list | tuple) else []
    if not pairs or any(len(pair) != 2 or pair[0] not in DIRECTIONS for pair in pairs):
        raise InvalidValueError(
            f"study.objectives is {objectives!r}, but it must be a list such as [minimize mean_steps, maximize solved]"
        )
    by_name = {name: direction for direction, name in pairs}
    if len(by_name) < len(pairs):
        raise InvalidValueError(f"study.objectives is {list(objectives)!r}, but no figure may be there twice")
    return by_name


def _seeds(seeds: Any, at_most: int) -> tuple[int, ...]:
    if not isinstance(seeds, list | tuple) or not seeds:
        raise InvalidValueError(f"study.seeds is {seeds!r}, but it must be a list of at least one seed, such as [0, 1]")
    checked = check_ints("study.seeds", seeds, None, "", at_least=0, at_most=at_most)
    if len(set(checked)) < len(checked):
        raise InvalidValueError(f"study.seeds is {list(checked)}, but no seed may be there twice")
    return checked

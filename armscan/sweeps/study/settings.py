"""The section `study` of the configuration, checked with Pydantic."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, ValidationInfo, model_validator

from armscan.errors import InvalidValueError, listed
from armscan.sweeps.scheduling.scheduler import Limits
from armscan.sweeps.space.space import Space
from armscan.utils.validation import LARGEST_SEED, check_ints

NAME, MAX_NAME_CHARS = re.compile(r"\w[\w\-.]*"), 100
# The study of the final trainings is called like the study, with this suffix.
FINAL_EVAL_SUFFIX = "-judged"
# The first final seed is this much above the largest seed of the search.
FIRST_SEED_ABOVE, MAX_FINAL_SEEDS = 1000, 1000
LARGEST_SEARCH_SEED = LARGEST_SEED - FIRST_SEED_ABOVE - MAX_FINAL_SEEDS
# Set by the command, for each worker.
NOT_READ = ("worker",)
DIRECTIONS, NO_PRUNER = ("minimize", "maximize"), "optuna.pruners.NopPruner"


def check_study_name(where: str, name: Any) -> str:
    """Return the name of a study, if it is one."""
    if not isinstance(name, str) or not NAME.fullmatch(name) or len(name) > MAX_NAME_CHARS:
        raise InvalidValueError(
            f"{where} is {name!r}, but it must begin with a letter, a digit or _, go on with these, - and ., and have "
            f"at most {MAX_NAME_CHARS} characters"
        )
    if name.endswith(FINAL_EVAL_SUFFIX):
        raise InvalidValueError(
            f"{where} is {name!r}, but the suffix {FINAL_EVAL_SUFFIX} is reserved for final evaluations"
        )
    return name


def _place(value: Any, info: ValidationInfo) -> str:
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        raise InvalidValueError(f"study.{info.field_name} is {value!r}, but it must be a text that says where")
    return value


def _with_target(value: Any, info: ValidationInfo) -> Mapping[str, Any]:
    if not isinstance(value, Mapping) or "." not in str(value.get("_target_")):
        raise InvalidValueError(
            f"study.{info.field_name} is {value!r}, but it must have a _target_, the name of a class"
        )
    return value


def _objectives(objectives: Any) -> Mapping[str, str]:
    """Return the direction of each metric, of texts such as `minimize mean_steps`."""
    if isinstance(objectives, Mapping):
        return objectives
    pairs = [str(each).split() for each in objectives] if isinstance(objectives, list | tuple) else []
    if not pairs or any(len(pair) != 2 or pair[0] not in DIRECTIONS for pair in pairs):
        raise InvalidValueError(
            f"study.objectives is {objectives!r}, but it must be a list such as [minimize mean_steps, maximize solved]"
        )
    by_name = {name: direction for direction, name in pairs}
    if len(by_name) < len(pairs):
        raise InvalidValueError(f"study.objectives is {list(objectives)!r}, but no metric may be there twice")
    return by_name


def _seeds(seeds: Any) -> tuple[int, ...]:
    if not isinstance(seeds, list | tuple) or not seeds:
        raise InvalidValueError(f"study.seeds is {seeds!r}, but it must be a list of at least one seed, such as [0, 1]")
    checked = check_ints("study.seeds", seeds, None, "", at_least=0, at_most=LARGEST_SEARCH_SEED)
    if len(set(checked)) < len(checked):
        raise InvalidValueError(f"study.seeds is {list(checked)}, but no seed may be there twice")
    return checked


Name = Annotated[str, BeforeValidator(lambda name: check_study_name("study.name", name))]
Place = Annotated[str, BeforeValidator(_place)]
Target = Annotated[Mapping[str, Any], BeforeValidator(_with_target)]
NonNegative = Annotated[int, Field(ge=0, description="a whole number of at least 0")]
Positive = Annotated[int, Field(ge=1, description="a whole number of at least 1")]
Flag = Annotated[bool, Field(description="true or false")]


class _Section(BaseModel):
    """Takes no other keys, and no value of another type."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True)


class FinalEvalSettings(_Section):
    """The final evaluation of the best configurations.

    Args:
        top_k: number of configurations; 0 for no final evaluation.
        n_seeds: trainings of each, with seeds that no search trial was run with.
    """

    top_k: NonNegative
    n_seeds: int = Field(ge=1, le=MAX_FINAL_SEEDS, description=f"a whole number from 1 to {MAX_FINAL_SEEDS}")


class StudySettings(_Section):
    """What a study is asked to do.

    Args:
        name: of the study, in its storage and of its folder.
        storage: where it is kept, as `open_storage` takes it.
        folder: of its trials.
        artifacts: folder of the plots for Optuna's dashboard.
        task: what makes a `Task`, as Hydra would instantiate it.
        space: what is searched.
        objectives: direction by the name of each metric.
        sampler: what makes an Optuna sampler of a seed, as Hydra would instantiate it.
        pruner: an Optuna pruner, likewise.
        prune_after_env_steps: environment steps of a trial before it may be pruned.
        n_trials: number of trials that finish.
        max_failures: failed trials, after which the study ends.
        max_retries: retries of a trial whose worker died.
        timeout_hours: wall time in which trials run, for the whole study; None for no limit.
        max_env_steps: environment steps of all trials together; None for no limit.
        workers: trials at a time, of this start.
        seed: of the samplers.
        seeds: that each trial is run with, one after another.
        final_eval: of the best at the end.
        allow_config_changes: whether to resume although the fixed configuration has changed.
    """

    name: Name
    storage: Place
    folder: Place
    artifacts: Place
    task: Target
    space: Space
    objectives: Annotated[Mapping[str, str], BeforeValidator(_objectives)]
    sampler: Target
    pruner: Target
    prune_after_env_steps: Positive
    n_trials: Positive
    max_failures: NonNegative
    max_retries: NonNegative
    timeout_hours: float | None = Field(gt=0, allow_inf_nan=False, description="a finite number above 0, or null")
    max_env_steps: int | None = Field(ge=1, description="a whole number of at least 1, or null")
    workers: Positive
    seed: int = Field(ge=0, le=LARGEST_SEED, description=f"a whole number from 0 to {LARGEST_SEED}")
    seeds: Annotated[tuple[int, ...], BeforeValidator(_seeds)]
    final_eval: FinalEvalSettings = Field(description="a section with top_k and n_seeds")
    allow_config_changes: Flag

    @classmethod
    def read(cls, section: Mapping[str, Any], fixed: Mapping[str, Any]) -> Self:
        """Return the settings of a configuration's section.

        Args:
            section: with plain values.
            fixed: keys of the configuration that have been given a value, which are not searched.

        Raises:
            InvalidValueError: if a key is unknown, missing or has a value that is not allowed.
        """
        values = {key: value for key, value in section.items() if key not in NOT_READ}
        if "space" in values:
            values["space"] = Space.read(values["space"]).without(fixed)
            if not values["space"].parameters:
                raise InvalidValueError("nothing is left to search: each key of study.space is given a value")
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise InvalidValueError(_first_mistake(error)) from error

    @model_validator(mode="after")
    def _can_prune(self) -> Self:
        if len(self.objectives) > 1 and self.pruner["_target_"] != NO_PRUNER:
            raise InvalidValueError(
                f"study.pruner is {self.pruner['_target_']}, but trials of several objectives cannot be pruned: give "
                "study/pruner=none"
            )
        return self

    @property
    def final_eval_name(self) -> str:
        """The name of the study of the final trainings."""
        return self.name + FINAL_EVAL_SUFFIX

    @property
    def limits(self) -> Limits:
        """When the search has enough."""
        return Limits(
            n_trials=self.n_trials,
            max_failures=self.max_failures,
            max_retries=self.max_retries,
            hours=self.timeout_hours,
            env_steps=self.max_env_steps,
        )

    def check_workers(self, n_cores: int) -> None:
        """Raise `InvalidValueError` if the workers' compute threads are more than the cores of one machine."""
        n_threads = int(os.environ.get("OMP_NUM_THREADS", "1"))
        if self.workers * n_threads > n_cores:
            each = "" if n_threads == 1 else f" of {n_threads} compute threads each (OMP_NUM_THREADS)"
            raise InvalidValueError(
                f"study.workers is {self.workers}{each}, but this machine has {n_cores} cores: give at most "
                f"{max(1, n_cores // n_threads)}"
            )


def _first_mistake(error: ValidationError) -> str:
    """Return a line with the key, the value received and what is allowed, of the first mistake."""
    mistake = error.errors(include_url=False)[0]
    if mistake["type"] == "value_error":
        return str(mistake["ctx"]["error"])
    *sections, key = map(str, mistake["loc"])
    where, model = ".".join(["study", *sections]), FinalEvalSettings if sections else StudySettings
    if mistake["type"] == "extra_forbidden":
        return f"there is no key {key!r} in {where}, but only {listed(sorted(model.model_fields))}"
    if mistake["type"] == "missing":
        return f"{where}.{key} is not set, but it must be"
    return f"{where}.{key} is {mistake['input']!r}, but it must be {model.model_fields[key].description}"

"""The section `study` of the configuration, checked with Pydantic."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from armscan.errors import InvalidValueError, listed
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.race import MAX_SEEDS_FACTOR
from armscan.sweeps.space.space import Space
from armscan.sweeps.storage.attributes import FINAL_SUFFIXES
from armscan.sweeps.study.constraints import Constraint
from armscan.utils.section import Section
from armscan.utils.text import counted
from armscan.utils.validation import MAX_SEED

NAME = re.compile(rf"(?!.*(?:{'|'.join(FINAL_SUFFIXES)})$)\w[\w\-.]{{0,99}}")
# Distances of the first selection seed and the first test seed from the largest search seed, and the maximum
# number of seeds of a configuration in each.
SELECTION_SEEDS_ABOVE, TEST_SEEDS_ABOVE, MAX_FINAL_SEEDS = 1000, 2000, 1000
MAX_SEARCH_SEED = MAX_SEED - TEST_SEEDS_ABOVE - MAX_FINAL_SEEDS
T = TypeVar("T")
OPTUNA_PRUNERS = "optuna.pruners."
NO_PRUNER = f"{OPTUNA_PRUNERS}NopPruner"


def check_study_name(where: str, name: Any) -> str:
    """Return the name of a study; raise `InvalidValueError` if it is not a valid one."""
    if isinstance(name, int | float) and not isinstance(name, bool):
        raise InvalidValueError(f"{where} is {name!r}, a number, but it must be a string: begin it with a letter")
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise InvalidValueError(
            f"{where} is {name!r}, but it must begin with a letter, a digit or _, go on with these, - and ., have at "
            f"most 100 characters and not end in {listed(FINAL_SUFFIXES)}, as final evaluations do"
        )
    return name


# A validator that raises without a message leaves the message to the description of the field.
def _target(described: Mapping[str, Any]) -> Mapping[str, Any]:
    if "." not in str(described.get("_target_")):
        raise ValueError
    return described


def _objectives(objectives: Any) -> Any:
    """Return the direction of each metric, from strings such as `minimize mean_steps`."""
    if isinstance(objectives, list):
        directions = {name: direction for direction, _, name in (str(each).partition(" ") for each in objectives)}
        return directions if len(directions) == len(objectives) else None
    return objectives


def _constraints(constraints: Any) -> Any:
    return tuple(map(Constraint.read, constraints)) if isinstance(constraints, list | tuple) else constraints


def _without_repetition(given: tuple[T, ...]) -> tuple[T, ...]:
    if len(set(given)) < len(given):
        raise ValueError
    return given


Name = Annotated[str, BeforeValidator(lambda name: check_study_name("study.name", name))]
Other = Annotated[str, BeforeValidator(lambda name: check_study_name("study.warm_start", name))]
# Not blank, and without null characters, which no path can have.
Place = Annotated[str, Field(pattern=r"^[^\x00]*[^\s\x00][^\x00]*$", description="a string that says where")]
Target = Annotated[
    Mapping[str, Any], AfterValidator(_target), Field(description="a section with a _target_, the name of a class")
]
Preset = Annotated[str, Field(pattern=r"^\w[\w\-/]*$")]
Metric = Annotated[str, Field(pattern=r"^\S+$")]
Direction = Literal["minimize", "maximize"]
Positive = Annotated[int, Field(ge=1, description="a whole number of at least 1")]
Seed = Annotated[int, Field(strict=True, ge=0, le=MAX_SEARCH_SEED)]


SeedCount = Annotated[int, Field(ge=1, le=MAX_FINAL_SEEDS, description=f"a whole number from 1 to {MAX_FINAL_SEEDS}")]
MAX_MEAN_SEEDS = MAX_FINAL_SEEDS // MAX_SEEDS_FACTOR
MeanSeeds = Annotated[int, Field(ge=1, le=MAX_MEAN_SEEDS, description=f"a whole number from 1 to {MAX_MEAN_SEEDS}")]


class FinalEvalSettings(Section):
    """Settings of the final evaluation, which selects one of the best configurations and compares it with the control.

    The control is the configuration of the study without the searched values. The selection and the test have
    seeds of their own, which the search does not use.

    Args:
        top_k: Number of candidates, the best different configurations of the search, 0 or more; 0 for no final
            evaluation.
        min_seeds: Number of seeds of each candidate, and of the control, in the first round of the selection, from 1 to
            `mean_seeds`.
        mean_seeds: Maximum number of seeds of each on average in the whole selection, from 1 to 250; those that may be
            the best get more than others, but at most four times this number.
        test_seeds: Number of seeds of the chosen configuration, and of the control, on the test volumes, from 1 to
            1000.
        episodes: Number of episodes of each evaluation of a final training, 1 or more. Default: None, as many as
            `evaluation.episodes`.
    """

    top_k: int = Field(ge=0, description="a whole number of at least 0")
    min_seeds: MeanSeeds
    mean_seeds: MeanSeeds
    test_seeds: SeedCount
    episodes: int | None = Field(default=None, ge=1, description="a whole number of at least 1, or null")

    @model_validator(mode="before")
    @classmethod
    def _of_earlier_versions(cls, values: Any) -> Any:
        """Take stored `judge_seeds` as `test_seeds`; refuse old names in a sweep, beside the new default."""
        if not isinstance(values, Mapping) or not (old := {"n_seeds", "judge_seeds"} & values.keys()):
            return values
        if "test_seeds" in values:
            raise InvalidValueError(
                f"study.final_eval.{min(old)} is now study.final_eval.test_seeds: rename it in the sweep"
            )
        return {"test_seeds" if key in old else key: value for key, value in values.items()}

    @model_validator(mode="after")
    def _fewest_first(self) -> Self:
        if self.min_seeds > self.mean_seeds:
            raise InvalidValueError(
                f"study.final_eval.min_seeds is {self.min_seeds}, but it must be at most study.final_eval.mean_seeds, "
                f"which is {self.mean_seeds}"
            )
        return self


class StudySettings(Limits):
    """Settings of a study.

    Args:
        name: Name of the study in its storage, and of its folder.
        storage: Address of the storage; see `open_storage`.
        folder: Folder of the trials.
        artifacts: Folder of the plots for Optuna's dashboard.
        task: Config of a `Task`, which Hydra instantiates.
        space: Search space.
        objectives: Direction of each objective, by the name of its metric.
        constraints: Bounds that metrics of a trial must keep. Default: none.
        sampler: Config of an Optuna sampler, which Hydra instantiates with a seed.
        pruner: Config of an Optuna pruner, which Hydra instantiates.
        terminator: Config of a `Terminator`, which Hydra instantiates. Default: None, to run every trial.
        prune_after_env_steps: Environment steps of a trial before it may be pruned, 1 or more.
        warm_start: Names of studies of the same storage that provide the first trials. Default: none.
        enqueue: Presets whose settings are tried first; `default` is the study's own configuration. Default: none.
        workers: Number of workers that this command starts, 1 or more.
        seed: Seed of the samplers.
        seeds: Training seeds of each trial, used one after another.
        final_eval: Final evaluation of the best configurations.
        allow_config_changes: Whether to resume although the fixed configuration, or the volumes, have changed.
    """

    name: Name
    storage: Place
    folder: Place
    artifacts: Place
    task: Target
    space: Space
    objectives: Annotated[dict[Metric, Direction], BeforeValidator(_objectives)] = Field(
        min_length=1, description="a list such as [minimize mean_steps, maximize solved], with no metric twice"
    )
    constraints: Annotated[tuple[Constraint, ...], BeforeValidator(_constraints)] = Field(
        default=(), strict=False, description="a list such as ['training_s <= 60', 'env_steps <= 20000']"
    )
    sampler: Target
    pruner: Target
    terminator: Target | None = Field(default=None, description="a section with a _target_, or null")
    prune_after_env_steps: Positive
    warm_start: Annotated[tuple[Other, ...], AfterValidator(_without_repetition)] = Field(
        default=(), strict=False, description="a list of names of studies, none twice"
    )
    enqueue: Annotated[tuple[Preset, ...], AfterValidator(_without_repetition)] = Field(
        default=(), strict=False, description="a list of names of presets, or 'default', none twice"
    )
    workers: Positive
    seed: int = Field(ge=0, le=MAX_SEED, description=f"a whole number from 0 to {MAX_SEED}")
    seeds: Annotated[tuple[Seed, ...], AfterValidator(_without_repetition)] = Field(
        strict=False,
        min_length=1,
        description=f"a list of at least one seed, such as [0, 1], none twice and none above {MAX_SEARCH_SEED}",
    )
    final_eval: FinalEvalSettings = Field(description="a section with top_k, min_seeds, mean_seeds and others")
    allow_config_changes: bool = Field(description="true or false")

    @model_validator(mode="after")
    def _can_prune(self) -> Self:
        target = self.pruner["_target_"]
        # All pruners of Optuna compare one value.
        if len(self.objectives) > 1 and target.startswith(OPTUNA_PRUNERS) and target != NO_PRUNER:
            raise InvalidValueError(
                f"study.pruner is {target}, which compares one objective, but study.objectives has "
                f"{len(self.objectives)}: give study/pruner=pareto, or study/pruner=none"
            )
        return self

    @property
    def asked(self) -> str:
        """Return the requested number of trials and the terminator as JSON; an ended study continues if they change."""
        terminator = dict(self.terminator) if self.terminator is not None else None
        return json.dumps({"n_trials": self.n_trials, "terminator": terminator}, sort_keys=True)

    def check_workers(self, n_cores: int) -> None:
        """Raise `InvalidValueError` if the workers have more compute threads than their machine has cores."""
        # OpenMP allows a number for each level of nesting.
        given = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip() or "1"
        if not given.isdecimal() or int(given) < 1:
            raise InvalidValueError(f"OMP_NUM_THREADS is {given!r}, but it must be a number of threads, 1 or more")
        n_threads = int(given)
        if self.workers * n_threads > n_cores:
            each = "" if n_threads == 1 else f" of {n_threads} compute threads each (OMP_NUM_THREADS)"
            raise InvalidValueError(
                f"study.workers is {self.workers}{each}, but this machine has {counted(n_cores, 'core')}: give at most "
                f"{max(1, n_cores // n_threads)}"
            )

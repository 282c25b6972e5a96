"""Command line of a study: its name, the overrides of its trials, and its launcher."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from armscan.config.command_hints import run_command
from armscan.config.compose import compose, reduce_to_run
from armscan.config.defaults import MULTIRUN, NOT_SEARCHED, PLAN, RESUME
from armscan.config.literal import hydra_literal
from armscan.config.sources import SWEEP
from armscan.errors import InvalidValueError
from armscan.experiment.build import check_config
from armscan.experiment.effects import check_effects
from armscan.launch.launchers import LAUNCHER

STUDY = "study"
TASK_TARGET, TRAINING_TASK = "study.task._target_", "armscan.sweeps.tasks.training.TrainingTask"
DEFAULT_LAUNCHER = "submitit_local"
WORKER_KEY, SPACE, STORAGE, SEARCH_PATH = "study.worker", "study.space", "study.storage", "hydra.searchpath"
# An override of the space, of one of its keys, or of a part of a key, such as the lower end of its range.
SPACE_OVERRIDE = re.compile(r"\+*study\.space(?:\.(.+?)(?:\.(low|high|log|step|choices|when))?)?=(.*)", re.DOTALL)
NO_RANGE = ",low:null,high:null,log:null,step:null"


@dataclass(frozen=True)
class StudyCommand:
    """The checked overrides of a study's command line, and whether to show the plan only."""

    overrides: tuple[str, ...]
    is_plan: bool

    @classmethod
    def read(cls, arguments: Sequence[str]) -> Self:
        """Parse the arguments of the command line."""
        overrides = [each for each in arguments if each not in (*MULTIRUN, PLAN)]
        parsed = OverridesParser.create().parse_overrides(overrides)
        keys = [each.key_or_group for each in parsed]
        if (n_given := keys.count(SWEEP)) != 1:
            given = f"is given {n_given} times" if n_given else "is not set"
            raise InvalidValueError(f"{SWEEP} {given}, but it must be once: give {SWEEP}=NAME")
        if not {*MULTIRUN} & {*arguments}:
            raise InvalidValueError(f"a study has many runs, which needs -m: {run_command(['-m', *arguments])}")
        if RESUME in keys:
            raise InvalidValueError(f"{RESUME} is not for a study, which resumes by its own command: type that again")
        if STUDY in keys:
            raise InvalidValueError("study is a section of the configuration: give its keys, such as study.n_trials=40")
        for override in parsed:
            _check(override)
        changed = filter(None, map(SPACE_OVERRIDE.fullmatch, overrides))
        searched = {key for key, _, value in (each.groups() for each in changed) if value != "null"}
        if both := [key for key in keys if key in searched]:
            raise InvalidValueError(f"{both[0]} is given a value, and {SPACE}.{both[0]} to search it: give one of them")
        return cls(tuple(_with_one_space(overrides)), PLAN in arguments)

    @property
    def launching(self) -> list[str]:
        """Overrides of the command line that launches the workers."""
        is_chosen = any(each.startswith(f"{LAUNCHER}=") for each in self.overrides)
        return [*self.overrides, *([] if is_chosen else [f"{LAUNCHER}={DEFAULT_LAUNCHER}"])]


def trial_overrides(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that the configuration of a trial is composed from.

    Overrides of Hydra itself only concern the launch of workers, except for the search path.
    """
    others = ("hydra", f"{WORKER_KEY}=")
    return [each for each in overrides if not each.lstrip("+~").startswith(others) or each.startswith(SEARCH_PATH)]


def check_training_overrides(arguments: Sequence[str]) -> None:
    """Check the configuration of a study's trainings like a run's, before Optuna is loaded.

    Args:
        arguments: Arguments of the command line; those of a study whose task is not training are left to its task.

    Raises:
        InvalidValueError: If a value is not allowed.
    """
    overrides = trial_overrides(StudyCommand.read(arguments).overrides)
    config = compose(overrides, return_hydra_config=True)
    if OmegaConf.select(config, TASK_TARGET) == TRAINING_TASK:
        of_trainings = reduce_to_run(config)[0]
        check_config(of_trainings)
        check_effects(of_trainings, overrides)


def fixed_by(overrides: Sequence[str]) -> dict[str, Any]:
    """Return the values that overrides give to keys and groups of the configuration."""
    return {each.key_or_group: each.value() for each in OverridesParser.create().parse_overrides(list(overrides))}


def _with_one_space(overrides: Sequence[str]) -> list[str]:
    """Return overrides with at most one of the study's space: of several, Hydra's launcher keeps the last alone."""
    others = [each for each in overrides if SPACE_OVERRIDE.fullmatch(each) is None]
    changes = [_merging(each) for each in overrides if SPACE_OVERRIDE.fullmatch(each)]
    given = [fixed_by([change])[SPACE] for change in changes]
    # A space that is no mapping is refused by the study's settings.
    if len(changes) < 2 or not all(isinstance(each, Mapping) for each in given):
        return [*others, *changes]
    merged: dict[str, Any] = {}
    for each in given:
        for key, described in each.items():
            is_part = isinstance(described, Mapping) and isinstance(merged.get(key), Mapping)
            merged[key] = {**merged[key], **described} if is_part else described
    return [*others, f"++{SPACE}={hydra_literal(merged)}"]


def _merging(override: str) -> str:
    """Return an override; one that changes the study's space is rewritten, so that Hydra merges it key by key."""
    given = SPACE_OVERRIDE.fullmatch(override)
    if given is None:
        return override
    key, part, value = given.groups()
    if part:
        # Choices replace a range.
        value = f"{{{part}:{value}{NO_RANGE if part == 'choices' else ''}}}"
    return f"++{SPACE}={{{key}:{value}}}" if key else f"++{SPACE}={value}"


def _check(override: Override) -> None:
    key, value = override.key_or_group, override.value()
    if key == "seed":
        raise InvalidValueError(
            f"{override.input_line!r} has no effect in a study: study.seeds are the seeds of each trial, study.seed "
            "is that of the sampler"
        )
    if override.is_sweep_override():
        instead = f"those of a study come from its space: give '{SPACE}.{key}.choices=[...]'"
        if key.startswith(NOT_SEARCHED):
            instead = "a study has one: 'KEY=[...]' is a list"
        raise InvalidValueError(f"{override.input_line!r} gives several values, but {instead}")
    if key == SEARCH_PATH:
        for folder in map(str, value if isinstance(value, list) else [value]):
            path = folder.removeprefix("file://")
            if "://" not in path and not Path(path).is_dir():
                raise InvalidValueError(f"{SEARCH_PATH} names {path!r}, but there is no such folder")

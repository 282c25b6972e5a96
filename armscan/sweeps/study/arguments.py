"""What the words of a command line say of a study: which it is, what its trials are composed of, who launches it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, QuotedString

from armscan.config.command_hints import run_command
from armscan.config.defaults import MULTIRUN, PLAN, RESUME
from armscan.config.sources import SWEEP
from armscan.errors import InvalidValueError
from armscan.launch.launchers import LAUNCHER
from armscan.sweeps.space.parse import NOT_SEARCHED

STUDY = "study"
USUAL_LAUNCHER = "submitit_local"
WORKER_KEY, SPACE, STORAGE, SEARCH_PATH = "study.worker", "study.space", "study.storage", "hydra.searchpath"


@dataclass(frozen=True)
class StudyCommand:
    """The words that a person has given for a study, checked.

    Args:
        words: but for the options, as Hydra takes them.
        is_plan: whether only to show what would be run.
    """

    words: tuple[str, ...]
    is_plan: bool

    @classmethod
    def read(cls, words: Sequence[str]) -> Self:
        """Return what the words of the command line say.

        Raises:
            InvalidValueError: if they say something that no study can do.
        """
        options = [word for word in words if word in (*MULTIRUN, PLAN)]
        own = tuple(_merging(word) for word in words if word not in options)
        chosen = [word for word in own if word.startswith(f"{SWEEP}=")]
        if len(chosen) != 1:
            given = f"is given {len(chosen)} times" if chosen else "is not set"
            raise InvalidValueError(f"{SWEEP} {given}, but it must be once: give {SWEEP}=NAME")
        if not {*MULTIRUN} & {*options}:
            raise InvalidValueError(f"a study has many runs, which needs -m: {run_command(['-m', *own, *options])}")
        if resumed := [word for word in own if word.startswith(f"{RESUME}=")]:
            raise InvalidValueError(f"{resumed[0]!r} is not for a study, which goes on where it stands by itself")
        overrides = _overrides(own)
        if [whole for whole in overrides if whole.key_or_group == STUDY]:
            raise InvalidValueError("study is a section of the configuration: give its keys, such as study.n_trials=40")
        _check_single_values(overrides)
        _check_search_path(overrides)
        return cls(own, PLAN in options)

    @property
    def launching(self) -> list[str]:
        """The words that the workers are launched with."""
        is_chosen = any(word.startswith(f"{LAUNCHER}=") for word in self.words)
        return [*self.words, *([] if is_chosen else [f"{LAUNCHER}={USUAL_LAUNCHER}"])]

    @property
    def of_trials(self) -> list[str]:
        """The words that the configuration of a trial is composed of."""
        return words_of_trials(self.words)


def words_of_trials(words: Sequence[str]) -> list[str]:
    """Return the words that the configuration of a trial is composed of.

    Those of Hydra itself are for the launching of workers, but for the one that says where configurations are found.
    """
    others = ("hydra", f"{WORKER_KEY}=")
    return [word for word in words if not word.lstrip("+~").startswith(others) or word.startswith(SEARCH_PATH)]


def fixed_by(words: Sequence[str]) -> dict[str, Any]:
    """Return the values that words give to keys and groups of the configuration."""
    return {each.key_or_group: _plain(each.value()) for each in _overrides(words)}


def _merging(word: str) -> str:
    """Return a word so that it can add to the space of the study, which Hydra would refuse."""
    key = word.partition("=")[0]
    return f"++{word}" if key == SPACE or key.startswith(f"{SPACE}.") else word


def _overrides(words: Sequence[str]) -> list[Override]:
    return OverridesParser.create().parse_overrides(list(words))


def _plain(value: Any) -> Any:
    if isinstance(value, QuotedString):
        return value.text
    if isinstance(value, list):
        return [_plain(each) for each in value]
    if isinstance(value, dict):
        return {str(_plain(key)): _plain(each) for key, each in value.items()}
    return value


def _check_single_values(overrides: Sequence[Override]) -> None:
    for override in overrides:
        if override.is_sweep_override() and override.key_or_group.startswith(NOT_SEARCHED):
            raise InvalidValueError(
                f"{override.input_line!r} gives several values, but a study has one: 'KEY=[...]' is a list"
            )
        if override.is_sweep_override():
            raise InvalidValueError(
                f"{override.input_line!r} gives several values, but those of a study come from its space: give "
                f"'{SPACE}.{override.key_or_group}.choices=[...]'"
            )


def _check_search_path(overrides: Sequence[Override]) -> None:
    for override in overrides:
        if override.key_or_group != SEARCH_PATH:
            continue
        folders = _plain(override.value())
        for folder in folders if isinstance(folders, list) else [folders]:
            path = str(folder).removeprefix("file://")
            if "://" not in path and not Path(path).is_dir():
                raise InvalidValueError(f"{SEARCH_PATH} names {path!r}, but there is no such folder")

"""The fixed configuration of a study: what its trials share, stored with it and compared when it is started again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import optuna
from omegaconf import DictConfig

from armscan.config.defaults import ADDED, NOT_COMPARED, to_plain
from armscan.config.legacy import migrate
from armscan.config.literal import hydra_literal
from armscan.config.own_code import own_code
from armscan.config.trust import classes_in_groups
from armscan.errors import few
from armscan.sweeps.storage.attribute_names import EARLIER_CONFIGS, FIXED, MEMBER, OBJECTIVES, SPACE
from armscan.sweeps.study.arguments import STUDY, TRAINING_TASK, fixed_by
from armscan.sweeps.study.settings import StudySettings
from armscan.tracking import flatten

N_SHOWN = 5
# Instead of the value of a key that a configuration does not have.
NOT_THERE = "not there"
CONSTRAINTS = "study.constraints"
# No trial of the search depends on it: it is stored because final trainings with another number begin anew.
FINAL_EPISODES = "study.final_eval.episodes"
# What gives a trial its value. A study without it is of an earlier version, in which it was the best validation.
TRIAL_VALUE, NEW_EPISODES, BEST_VALIDATION = "study.trial_value", "new episodes", "best validation"
# Among the compared settings: the size and interval of a population, the overrides below a searched group, and
# checksums of the volumes and of the modules of own classes. A study that lacks one, as those of earlier versions do,
# is not compared by it.
LATER = POPULATION, OVERRIDES, VOLUMES, CODE = "study.population", "study.overrides", "study.volumes", "study.code"


def fixed_config(
    config: DictConfig, overrides: Sequence[str], volumes: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the configuration of a study's trials, their overrides and volumes; see `comparable_settings`.

    Args:
        config: Configuration of its trials without the searched values.
        overrides: Overrides that its trials are composed from.
        volumes: Checksums of the volumes; see `volume_sums`. Default: None, they are not compared.
    """
    return to_plain(config) | {STUDY: {"overrides": fixed_by(overrides), "volumes": volumes or {}}}


def comparable_settings(settings: StudySettings, fixed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that a study stores, which are compared when it is started again."""
    names = [each.name for each in settings.space.parameters]
    searched, not_compared = tuple(f"{name}." for name in names), tuple(f"{key}." for key in NOT_COMPARED)
    given, sampler = fixed.get(STUDY, {}), settings.sampler
    of_trials: dict[str, Any] = {"study.seeds": list(settings.seeds), "study.task": settings.task["_target_"]}
    of_trials[FINAL_EPISODES] = settings.final_eval.episodes
    if settings.constraints:
        of_trials[CONSTRAINTS] = list(map(str, settings.constraints))
    is_population = "interval_env_steps" in sampler
    if settings.task["_target_"] == TRAINING_TASK and not is_population:
        of_trials[TRIAL_VALUE] = NEW_EPISODES
    of_trials[POPULATION] = [sampler.get("population"), sampler["interval_env_steps"]] if is_population else None
    # A trial chooses all other keys of a searched group.
    of_trials[OVERRIDES] = [
        f"{key}={hydra_literal(value)}"
        for key, value in sorted(given.get("overrides", {}).items())
        if f"{key}.".startswith(searched) and not f"{key}.".startswith(not_compared)
    ]
    if not any(f"{name}.".startswith("data.") for name in names):
        of_trials |= {f"{VOLUMES}.{part}": volumes for part, volumes in given.get("volumes", {}).items()}
    code = own_code(
        {**fixed, "task": settings.task},
        classes_in_groups({each.name: each.extremes for each in settings.space.parameters}),
    )
    of_trials |= {f"{CODE}.{module}": checksum for module, checksum in code.items()}
    left_out = (*not_compared, *searched, f"{STUDY}.")
    shared = {key: value for key, value in flatten(fixed).items() if not f"{key}.".startswith(left_out)}
    shared = {key: value for key, value in shared.items() if key not in ADDED or value is not None}
    return {
        SPACE: settings.space.to_plain(),
        OBJECTIVES: dict(settings.objectives),
        FIXED: shared | of_trials,
    }


def fixed_of(study: optuna.Study, wanted: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the fixed configuration of a stored study, and the wanted one, without what only one of them compares."""
    there = migrate(study.user_attrs.get(FIXED, {}))
    trials = study.get_trials(deepcopy=False)
    if POPULATION not in there and trials and not any(MEMBER in trial.user_attrs for trial in trials):
        there[POPULATION] = None
    return _comparable(there, wanted[FIXED])


def differing(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the values that differ between two fixed configurations; `NOT_THERE` for a key that one does not have."""
    pairs = {key: (before.get(key, NOT_THERE), now.get(key, NOT_THERE)) for key in {**before, **now}}
    return {key: (then, today) for key, (then, today) in pairs.items() if then != today}


def _comparable(before: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return two fixed configurations without what only one of them compares, and what no trial depends on."""
    if TRIAL_VALUE in now:
        before = {TRIAL_VALUE: BEST_VALIDATION, **before}
    left_out = {FINAL_EPISODES, *(key for key in before.keys() ^ now.keys() if key.startswith(LATER))}
    before, now = ({key: each[key] for key in each if key not in left_out} for each in (before, now))
    return before, now


def config_changes(study: optuna.Study) -> dict[int, str]:
    """Return how the configuration changed while a study ran, by the number of the first trial after each change."""
    earlier = sorted((int(number), config) for number, config in study.user_attrs.get(EARLIER_CONFIGS, {}).items())
    configs = [migrate(config) for config in (*(config for _, config in earlier), study.user_attrs.get(FIXED, {}))]
    numbers = [number for number, _ in earlier]
    found = {
        number: listed_differences(*_comparable(*pair)) for number, pair in zip(numbers, pairwise(configs), strict=True)
    }
    return {number: differences for number, differences in found.items() if differences}


def change_notes(study: optuna.Study) -> list[str]:
    """Return a note on each change of a study's configuration."""
    return [
        f"trials before {number} had another configuration ({differences}), so their values do not compare with others"
        for number, differences in config_changes(study).items()
    ]


def listed_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return the first differences between two fixed configurations as text; empty if there are none."""
    return few([f"{key} was {then}, is {today}" for key, (then, today) in differing(before, now).items()], N_SHOWN)

"""A study in its storage, created or compared with the requested settings."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import optuna
from omegaconf import DictConfig
from optuna.exceptions import ExperimentalWarning
from optuna.pruners import BasePruner
from optuna.trial import FrozenTrial, TrialState

from armscan.config.defaults import ADDED, NOT_COMPARED, to_plain
from armscan.config.legacy import migrate, renamed
from armscan.config.own_code import own_code
from armscan.config.trust import classes_in_groups
from armscan.errors import StudyError, few
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.scheduling.state import is_feasible, loss_signs
from armscan.sweeps.space.parameter import hydra_literal
from armscan.sweeps.space.space import is_conditional
from armscan.sweeps.storage.attribute_names import (
    EARLIER_CONFIGS,
    FIXED,
    GENERATION,
    MEMBER,
    OBJECTIVES,
    OF_STUDY,
    SPACE,
)
from armscan.sweeps.storage.attributes import StudyAttributes, check_trials
from armscan.sweeps.storage.storage import Storage
from armscan.sweeps.study.arguments import STUDY, fixed_by
from armscan.sweeps.study.components import make
from armscan.sweeps.study.settings import StudySettings
from armscan.tracking import flatten

N_SHOWN = 5
# Instead of the value of a key that a configuration does not have.
NOT_THERE = "not there"
CONSTRAINTS, FINAL_EPISODES = "study.constraints", "study.final_eval.episodes"
# Among the compared settings: the size and interval of a population, the overrides below a searched group, and
# checksums of the volumes and of the modules of own classes. A study that lacks one, as those of earlier versions do,
# is not compared by it.
LATER = POPULATION, OVERRIDES, VOLUMES, CODE = "study.population", "study.overrides", "study.volumes", "study.code"


def make_study(storage: Storage, settings: StudySettings, fixed: Mapping[str, Any]) -> optuna.Study:
    """Create a study, or load the existing one.

    Args:
        storage: Storage of the study.
        settings: Settings of the study.
        fixed: Configuration of its trials without the searched values; see `fixed_config`.

    Raises:
        StudyError: If the study that exists searches another space, has other objectives or constraints, or was started
            with another configuration.
    """
    wanted = comparable_settings(settings, fixed)

    def made() -> optuna.Study:
        study = optuna.create_study(
            study_name=settings.name,
            storage=storage.optuna,
            pruner=make("pruner", settings.pruner, BasePruner),
            directions=[*settings.objectives.values()],
            load_if_exists=True,
        )
        if _lacks_settings(study, wanted):
            for key, value in wanted.items():
                study.set_user_attr(key, value)
        return study

    study = storage.exclusive(made)
    if _check_same(settings, study, wanted):
        storage.exclusive(lambda: _reconfigure(study, wanted[FIXED]))
    name_objectives(study, list(settings.objectives))
    return study


def _reconfigure(study: optuna.Study, wanted: Mapping[str, Any]) -> None:
    """Store another configuration for the trials to come, and the one of the trials until now."""
    there, n_trials = study.user_attrs, len(study.get_trials(deepcopy=False))
    if n_trials:
        # Two changes without a trial between them are one.
        study.set_user_attr(EARLIER_CONFIGS, {str(n_trials): there[FIXED]} | there.get(EARLIER_CONFIGS, {}))
    # The volumes are known to the command alone, not to its workers.
    kept = {key: value for key, value in there[FIXED].items() if key.startswith(VOLUMES)}
    study.set_user_attr(FIXED, {**kept, **wanted})


def name_objectives(study: optuna.Study, names: Sequence[str]) -> None:
    """Name the objectives of a study for Optuna's dashboard, unless they have names; older studies have none."""
    if study.metric_names is None:
        with warnings.catch_warnings():
            # The method may change, but Optuna's version range is pinned.
            warnings.simplefilter("ignore", ExperimentalWarning)
            study.set_metric_names(list(names))


def existing_study(storage: Storage | None, settings: StudySettings, fixed: Mapping[str, Any]) -> optuna.Study | None:
    """Return the study that these settings would continue, for reading; None if they would begin a new one.

    Args:
        storage: Storage of the study; None if there is none yet.
        settings: Settings of the study.
        fixed: Configuration of its trials without the searched values.

    Raises:
        StudyError: If the study searches another space, has other objectives or constraints, or was started with
            another configuration.
    """
    study = storage.study(settings.name) if storage is not None else None
    wanted = comparable_settings(settings, fixed)
    if study is None or _lacks_settings(study, wanted):
        return None
    _check_same(settings, study, wanted)
    return study


def is_reconfigured(study: optuna.Study, settings: StudySettings, fixed: Mapping[str, Any]) -> bool:
    """Return whether a stored study would go on with another configuration, and so with new final trainings."""
    return _check_same(settings, study, comparable_settings(settings, fixed))


def _lacks_settings(study: optuna.Study, wanted: Mapping[str, Any]) -> bool:
    """Return whether the process that created a study died before it stored its settings."""
    return not study.user_attrs.keys() >= wanted.keys() and not study.get_trials(deepcopy=False)


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
    # A study without it is of an earlier version, in which the value of a trial was its best validation.
    of_trials[FINAL_EPISODES] = settings.final_eval.episodes
    if settings.constraints:
        of_trials[CONSTRAINTS] = list(map(str, settings.constraints))
    is_population = "interval_env_steps" in sampler
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
    """Return two fixed configurations without what only one of them compares."""
    alone = {key for key in before.keys() ^ now.keys() if key.startswith(LATER)}
    before, now = ({key: each[key] for key in each if key not in alone} for each in (before, now))
    return before, now


def config_changes(study: optuna.Study) -> dict[int, str]:
    """Return how the configuration changed while a study ran, by the number of the first trial after each change."""
    earlier = sorted((int(number), config) for number, config in study.user_attrs.get(EARLIER_CONFIGS, {}).items())
    configs = [migrate(config) for config in (*(config for _, config in earlier), study.user_attrs.get(FIXED, {}))]
    found = {
        number: _differences(*_comparable(*pair)) for (number, _), pair in zip(earlier, pairwise(configs), strict=True)
    }
    return {number: differences for number, differences in found.items() if differences}


def change_notes(study: optuna.Study) -> list[str]:
    """Return a note on each change of a study's configuration."""
    return [
        f"trials before {number} had another configuration ({differences}), so their values do not compare with others"
        for number, differences in config_changes(study).items()
    ]


def is_ours(study: optuna.Study) -> bool:
    """Return whether armscan made a study, and not another program in the same storage.

    Raises:
        InvalidValueError: If a user attribute of it is of another type than armscan writes.
    """
    there = study.user_attrs
    if not there.keys() >= OF_STUDY:
        return False
    StudyAttributes.read(f"{study.study_name}.user_attrs", there)
    return [direction.name.lower() for direction in study.directions] == [*there[OBJECTIVES].values()]


def _check_same(settings: StudySettings, study: optuna.Study, wanted: Mapping[str, Any]) -> bool:
    """Return whether a study's trials have another configuration; raise if the settings do not allow that."""
    there = study.user_attrs
    if not is_ours(study):
        raise StudyError(f"study.name is {settings.name!r}, but that study in its storage was not made by armscan")
    check_trials(study)
    whose = f"the study {settings.name} in {settings.storage if '://' not in settings.storage else 'its storage'}"
    other = "; give study.name another value"
    for key, what in ((SPACE, "searches another space"), (OBJECTIVES, "has other objectives")):
        if differences := _differences(renamed(there.get(key, {})), wanted[key]):
            raise StudyError(f"{whose} {what}: {differences}{other}")
    # The values of its trials are in this order.
    if [*there[OBJECTIVES]] != [*wanted[OBJECTIVES]]:
        raise StudyError(f"{whose} has its objectives in another order: {', '.join(there[OBJECTIVES])}{other}")
    before, now = fixed_of(study, wanted)
    if differences := _differences(*({CONSTRAINTS: each.get(CONSTRAINTS, [])} for each in (before, now))):
        # Whether a trial keeps them was stored when it finished.
        raise StudyError(f"{whose} has other constraints: {differences}{other}")
    differences = _differences(before, now)
    if differences and not settings.allow_config_changes:
        raise StudyError(
            f"{whose} was started with another configuration: {differences}; accept that with "
            f"study.allow_config_changes=true, or give study.name another value"
        )
    return bool(differences)


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    return few([f"{key} was {then}, is {today}" for key, (then, today) in differing(before, now).items()], N_SHOWN)


def best_trials(study: optuna.Study, n_best: int) -> list[FrozenTrial]:
    """Return the best trials of a study, each with different values, the best first.

    Trials that violate a constraint are left out, and in a population all but each member's latest. So are trials
    that lack a value which every trial of armscan has: they were told to Optuna by others. With several objectives
    these are the trials on the Pareto front, ordered by the first objective.
    """
    several = len(study.directions) > 1
    found = study.best_trials if several else study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    space = renamed(study.user_attrs.get(SPACE, {}))
    required = {key for key, described in space.items() if not is_conditional(described)}
    trials = [trial for trial in found if required <= renamed(searched_values(trial)).keys()]
    by_generation = sorted(trials, key=lambda trial: trial.user_attrs.get(GENERATION, 0))
    latest = {trial.user_attrs[MEMBER]: trial for trial in by_generation if MEMBER in trial.user_attrs}
    trials = list(filter(is_feasible, latest.values() or trials))
    sign, *_ = loss_signs(study.directions)
    ranked = sorted(trials, key=lambda trial: (sign * trial.values[0], trial.number))
    different: dict[str, FrozenTrial] = {}
    for trial in ranked:
        different.setdefault(json.dumps(searched_values(trial), sort_keys=True), trial)
    return list(different.values())[:n_best]

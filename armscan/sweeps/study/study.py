"""A study in its storage, created or compared with the requested settings."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.pruners import BasePruner
from optuna.trial import FrozenTrial, TrialState

from armscan.config.legacy import renamed
from armscan.errors import StudyError
from armscan.sweeps.scheduling.population import searched_values
from armscan.sweeps.scheduling.state import is_feasible, loss_signs
from armscan.sweeps.space.space import in_words, is_conditional
from armscan.sweeps.storage.attribute_names import (
    EARLIER_CONFIGS,
    FIXED,
    GENERATION,
    MEMBER,
    OBJECTIVES,
    OF_STUDY,
    SEEDS,
    SPACE,
)
from armscan.sweeps.storage.attributes import StudyAttributes, check_trials
from armscan.sweeps.storage.storage import Storage
from armscan.sweeps.study.components import make
from armscan.sweeps.study.fixed_config import (
    CONSTRAINTS,
    FINAL_EPISODES,
    VOLUMES,
    comparable_settings,
    fixed_of,
    listed_differences,
)
from armscan.sweeps.study.settings import StudySettings


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
    there, trials = study.user_attrs, study.get_trials(deepcopy=False)
    if listed_differences(*fixed_of(study, {FIXED: wanted})):
        # The value of a trial is over seeds of one configuration.
        for trial in trials:
            if not trial.state.is_finished() and trial.user_attrs.get(SEEDS):
                study._storage.set_trial_user_attr(trial._trial_id, SEEDS, {})
    if n_trials := len(trials):
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
    """Return whether a study's configuration is another one; raise if the settings do not allow that of its trials."""
    there = study.user_attrs
    if not is_ours(study):
        raise StudyError(f"study.name is {settings.name!r}, but that study in its storage was not made by armscan")
    check_trials(study)
    whose = f"the study {settings.name} in {settings.storage if '://' not in settings.storage else 'its storage'}"
    other = "; give study.name another value"
    spaces = renamed(there.get(SPACE, {})), wanted[SPACE]
    if differences := listed_differences(*spaces):
        # Words may be the same for different choices, such as 1 and the text 1.
        differences = listed_differences(*map(in_words, spaces)) or differences
        raise StudyError(
            f"{whose} searches another space: {differences}{other}, and study.warm_start=[{settings.name}] to begin "
            "with its trials"
        )
    if differences := listed_differences(there.get(OBJECTIVES, {}), wanted[OBJECTIVES]):
        raise StudyError(f"{whose} has other objectives: {differences}{other}")
    # The values of its trials are in this order.
    if [*there[OBJECTIVES]] != [*wanted[OBJECTIVES]]:
        raise StudyError(f"{whose} has its objectives in another order: {', '.join(there[OBJECTIVES])}{other}")
    before, now = fixed_of(study, wanted)
    if differences := listed_differences(*({CONSTRAINTS: each.get(CONSTRAINTS, [])} for each in (before, now))):
        # Whether a trial keeps them was stored when it finished.
        raise StudyError(f"{whose} has other constraints: {differences}{other}")
    differences = listed_differences(before, now)
    if differences and not settings.allow_config_changes:
        raise StudyError(
            f"{whose} was started with another configuration: {differences}; accept that with "
            f"study.allow_config_changes=true, or give study.name another value"
        )
    return bool(differences) or there[FIXED].get(FINAL_EPISODES) != wanted[FIXED][FINAL_EPISODES]


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

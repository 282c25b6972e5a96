"""Initial trials of a study: finished trials of other studies, and settings that are tried first."""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import optuna
from omegaconf import OmegaConf
from optuna.trial import FrozenTrial, create_trial

from armscan.config.compose import compose_run
from armscan.config.defaults import to_plain
from armscan.config.legacy import renamed
from armscan.config.literal import hydra_literal
from armscan.errors import StudyError, listed
from armscan.sweeps.scheduling.state import FINISHED
from armscan.sweeps.space.parameter import Value, optuna_value, overrides_of, rounded_overrides
from armscan.sweeps.space.space import Space
from armscan.sweeps.storage.attribute_names import (
    BEGUN_WITH,
    ENQUEUED_FROM,
    ENV_STEPS,
    METRICS,
    OBJECTIVES,
    SEEDS,
    SPACE,
    TAKEN_FROM,
)
from armscan.sweeps.storage.attributes import FINAL_SUFFIXES, check_trials
from armscan.sweeps.storage.reports import REPORT
from armscan.sweeps.storage.storage import Storage, existing_storage
from armscan.sweeps.study.arguments import SEARCH_PATH
from armscan.sweeps.study.fixed_config import NOT_THERE, comparable_settings, config_changes, differing, fixed_of
from armscan.sweeps.study.settings import OPTUNA_PRUNERS, StudySettings
from armscan.sweeps.study.study import best_trials, is_ours
from armscan.utils.text import counted

PRESET, SOURCE = "preset {}", "study {}"
# Number of best settings that are tried first, of a study with another configuration.
N_ENQUEUED = 10
# It would prune most trials that follow good ones (docs/sweep-bench-search.md#warm-start).
MEDIAN_PRUNER = f"{OPTUNA_PRUNERS}MedianPruner"
# In `study.enqueue`: the configuration of the study itself.
DEFAULT = "default"
# User attributes that a taken trial keeps.
KEPT = (METRICS, SEEDS, ENV_STEPS)


@dataclass(frozen=True)
class InitialTrials:
    """Initial trials of a study, all of one origin.

    Args:
        origin: Kind and name of their origin: `study NAME` or `preset NAME`.
        message: Line about the part that is taken, and why the rest is not.
        taken: Finished trials, with their values.
        enqueued: Settings to try first.
    """

    origin: str
    message: str
    taken: tuple[FrozenTrial, ...] = ()
    enqueued: tuple[dict[str, Value], ...] = ()

    def add(self, storage: Storage, study: optuna.Study) -> bool:
        """Add the trials to a study, once; return whether this call has added them."""

        def add() -> bool:
            begun_with = study.user_attrs.get(BEGUN_WITH, [])
            if self.origin in begun_with:
                return False
            # Places of trials that an earlier process added before it died.
            places = {trial.user_attrs.get(TAKEN_FROM) for trial in study.get_trials(deepcopy=False)}
            for trial in self.taken:
                if trial.user_attrs[TAKEN_FROM] not in places:
                    study.add_trial(trial)
            for chosen in self.enqueued:
                study.enqueue_trial(chosen, user_attrs={ENQUEUED_FROM: self.origin}, skip_if_exists=True)
            study.set_user_attr(BEGUN_WITH, [*begun_with, self.origin])
            return True

        return storage.exclusive(add)


def initial_trials(
    settings: StudySettings, overrides: Sequence[str], fixed: Mapping[str, Any], study: optuna.Study | None
) -> list[InitialTrials]:
    """Return the initial trials of a study, from `study.enqueue` and `study.warm_start`; finished trials come first.

    Those of an origin that the study has already begun with are left out.

    Args:
        settings: Settings of the study.
        overrides: Overrides that its trials are composed from.
        fixed: Configuration of its trials without the searched values.
        study: Study; None if it does not exist yet.

    Raises:
        StudyError: If the storage has no such study.
    """
    begun_with = study.user_attrs.get(BEGUN_WITH, ()) if study is not None else ()
    presets = [name for name in settings.enqueue if PRESET.format(name) not in begun_with]
    sources = [name for name in settings.warm_start if SOURCE.format(name) not in begun_with]
    storage = existing_storage(settings.storage) if sources else None
    initial = [_of_preset(settings.space, name, overrides) for name in presets]
    known = {_place(settings.name, trial) for trial in study.get_trials(deepcopy=False)} if study is not None else set()
    for name in sources:
        initial.append(_of_study(settings, name, fixed, storage, known))
        known |= {trial.user_attrs[TAKEN_FROM] for trial in initial[-1].taken}
    # Finished trials first: settings that have a value need not be tried again.
    return sorted(initial, key=lambda each: not each.taken)


def _of_preset(space: Space, name: str, overrides: Sequence[str]) -> InitialTrials:
    # The preset may be in a folder of the search path.
    of_preset = [*(each for each in overrides if each.startswith(SEARCH_PATH)), f"experiment={name}"]
    chosen, misfit = values_of(space, overrides if name == DEFAULT else of_preset)
    if misfit:
        return InitialTrials(PRESET.format(name), f"preset {name} is not tried: {misfit}")
    message = f"of preset {name}, the searched values are tried first: {' '.join(overrides_of(chosen))}"
    return InitialTrials(PRESET.format(name), message, (), (chosen,))


def values_of(space: Space, overrides: Sequence[str]) -> tuple[dict[str, Value], str | None]:
    """Return a configuration's values of the keys of a space, and the first misfit.

    Args:
        space: Space of the keys.
        overrides: Overrides that the configuration is composed from.

    Returns:
        See `Space.fit`.
    """
    config, choices = compose_run(overrides)
    # A group has the name that was chosen, any other key its value.
    found = {each.name: choices.get(each.name, OmegaConf.select(config, each.name)) for each in space.parameters}
    plain = {key: to_plain(value) if OmegaConf.is_config(value) else value for key, value in found.items()}
    return space.fit({key: optuna_value(value) for key, value in plain.items()})


def _of_study(
    settings: StudySettings, name: str, fixed: Mapping[str, Any], storage: Storage | None, known: Collection[str]
) -> InitialTrials:
    """Return the initial trials from another study, except those that this study has, at `known` places."""
    source, wanted = _source(settings, name, storage), comparable_settings(settings, fixed)
    trials = [trial for trial in source.get_trials(deepcopy=False) if trial.state in FINISHED]
    difference = _difference(source, wanted)
    # Only if the configurations agree: others may have values that no space has.
    before, now = ({}, {}) if difference else map(_plain, fixed_of(source, wanted))
    fitting: list[tuple[FrozenTrial, dict[str, Value]]] = []
    misfits = Counter[str]()
    first_number = max(config_changes(source), default=0)
    for trial in trials:
        params = renamed(trial.params)
        chosen, misfit = settings.space.fit(before | params, nearest=difference is not None)
        if not difference:
            misfit = misfit or _not_searched(params, chosen, now)
            # A value of an earlier configuration.
            misfit = misfit or ("its study had another configuration then" if trial.number < first_number else None)
        if misfit:
            misfits[misfit] += 1
        else:
            fitting.append((trial, chosen))
    message = f"warm start from {name}, which has {counted(len(trials), 'finished trial')}: "
    left = f"; {sum(misfits.values())} do not fit, such as: {misfits.most_common(1)[0][0]}" if misfits else ""
    if difference is None:
        new = [(trial, chosen) for trial, chosen in fitting if _place(name, trial) not in known]
        taken = tuple(_taken(name, trial, chosen, settings.space) for trial, chosen in new)
        there = f"; {len(fitting) - len(new)} already there" if len(new) < len(fitting) else ""
        return InitialTrials(SOURCE.format(name), f"{message}{len(taken)} taken with their values{there}{left}", taken)
    if _is_opposed(source, wanted):
        return InitialTrials(SOURCE.format(name), f"{message}none taken, because {difference}{left}", ())
    settings_of = {trial.number: chosen for trial, chosen in fitting if chosen}
    best = [trial for trial in best_trials(source, len(trials)) if trial.number in settings_of]
    first = first_different(settings_of[trial.number] for trial in best)
    tried = f"the settings of the best {len(first)} are tried first" if first else "it has no best trial to begin with"
    message += f"none taken with its value, because {difference}; {tried}"
    # Of equal settings, those of the best trial are tried.
    params_of = {repr(settings_of[trial.number]): renamed(trial.params) for trial in reversed(best)}
    if moved := [values for each in first if (values := _moved(params_of[repr(each)], each))]:
        message += f", {len(moved)} of them with the nearest values of the space, such as {moved[0]}"
    if first and settings.pruner["_target_"] == MEDIAN_PRUNER:
        message += "; study/pruner=percentile prunes fewer of the trials that follow than median does"
    return InitialTrials(SOURCE.format(name), message + left, (), first)


def _source(settings: StudySettings, name: str, storage: Storage | None) -> optuna.Study:
    names = [] if storage is None else storage.study_names
    others = sorted(each for each in names if each != settings.name and not each.endswith(FINAL_SUFFIXES))
    if storage is None or name not in others:
        there = listed(others) if others else "none is there"
        raise StudyError(f"study.warm_start names {name!r}, but it must be another study of the storage: {there}")
    source = optuna.load_study(study_name=name, storage=storage.optuna)
    if not is_ours(source):
        raise StudyError(f"study.warm_start names {name!r}, but that study was not made by armscan")
    check_trials(source)
    return source


def _difference(source: optuna.Study, wanted: Mapping[str, Any]) -> str | None:
    """Return the first difference, except in searched keys, that makes a study's values useless; None without one."""
    there = source.user_attrs
    # The values of a trial are in this order.
    if [*there[OBJECTIVES].items()] != [*wanted[OBJECTIVES].items()]:
        return f"its objectives are {' and '.join(f'{way} {name}' for name, way in there[OBJECTIVES].items())}"
    may_differ = tuple(f"{key}." for key in (*renamed(there[SPACE]), *wanted[SPACE]))
    different = differing(*fixed_of(source, wanted))
    found = [(key, pair) for key, pair in different.items() if not f"{key}.".startswith(may_differ)]
    if not found:
        return None
    key, (then, today) = found[0]
    more = f" ({counted(len(found) - 1, 'further difference')})" if len(found) > 1 else ""
    pair = f"{then}, which this study lacks" if today == NOT_THERE else f"{then}, and not {today}"
    return f"its {key} is {pair}{more}"


def _is_opposed(source: optuna.Study, wanted: Mapping[str, Any]) -> bool:
    """Return whether a study optimises an objective in the other direction: its best trials are the worst here."""
    there = source.user_attrs[OBJECTIVES]
    return any(there.get(name, way) != way for name, way in wanted[OBJECTIVES].items())


def _not_searched(params: Mapping[str, Value], chosen: Mapping[str, Value], fixed: Mapping[str, Value]) -> str | None:
    """Return which value of a trial this study neither searches nor has; None if there is none."""
    other = [key for key, value in params.items() if key not in chosen and (key not in fixed or fixed[key] != value)]
    return f"{other[0]}={hydra_literal(params[other[0]])}, which this study does not try" if other else None


def _moved(params: Mapping[str, Value], chosen: Mapping[str, Value]) -> str | None:
    """Return the first value that is not the trial's own, and that one; None if all are."""
    moved = [key for key, value in chosen.items() if value != params[key]]
    values = (rounded_overrides({moved[0]: each[moved[0]]})[0] for each in (chosen, params)) if moved else ()
    return " instead of ".join(values) or None


def _plain(flat: Mapping[str, Any]) -> dict[str, Value]:
    """Return the values of a flattened configuration, whose lists are JSON, as Optuna stores them."""
    return {key: optuna_value(_list_or_value(value)) for key, value in flat.items()}


def _list_or_value(value: Any) -> Any:
    """Return the list that a value describes; the value itself if it describes none, such as the text `[a] b`."""
    with contextlib.suppress(ValueError):
        return json.loads(value) if isinstance(value, str) and value.startswith("[") else value
    return value


def first_different(settings: Iterable[dict[str, Value]]) -> tuple[dict[str, Value], ...]:
    """Return the first ten different settings, which a warm start tries first."""
    first: list[dict[str, Value]] = []
    for each in settings:
        if len(first) < N_ENQUEUED and each not in first:
            first.append(each)
    return tuple(first)


def _place(name: str, trial: FrozenTrial) -> str:
    """Return where a trial was first run: the study, and its number there."""
    return str(trial.user_attrs.get(TAKEN_FROM, f"{name}:{trial.number}"))


def _taken(name: str, trial: FrozenTrial, chosen: dict[str, Value], space: Space) -> FrozenTrial:
    """Return a trial of another study as one of this study, with the study and number that it had there."""
    place = _place(name, trial)
    return create_trial(
        state=trial.state,
        values=trial.values,
        params=chosen,
        distributions={each.name: each.distribution for each in space.parameters if each.name in chosen},
        user_attrs={TAKEN_FROM: place} | {key: trial.user_attrs[key] for key in KEPT if key in trial.user_attrs},
        system_attrs={key: value for key, value in trial.system_attrs.items() if key.startswith(REPORT)},
        intermediate_values=trial.intermediate_values,
        constraints=trial.constraints,
    )

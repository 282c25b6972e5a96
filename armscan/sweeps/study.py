"""A study in its storage: made, or found and compared with what is asked for now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import optuna
from hydra.utils import instantiate
from optuna.study import StudyDirection

from armscan.errors import StudyError
from armscan.sweeps.settings import StudySettings
from armscan.sweeps.storage import Storage
from armscan.tracking import flattened

# User attributes of a study.
SPACE, FIXED, STUDY_RUN, DASHBOARD_OBJECTIVES = "space", "fixed_config", "mlflow_run", "objectives"
# Sections that say where and how things are computed and kept, not what.
NOT_COMPARED = ("tracking", "device", "compute.device", "seed")
N_SHOWN = 5


def open_study(storage: Storage, settings: StudySettings, name: str | None = None) -> optuna.Study:
    """Opens a study that exists.

    Args:
        storage: that it is in.
        settings: of it.
        name: its name; that of the settings where it is None.
    """
    pruner = instantiate(settings.pruner)
    return optuna.load_study(study_name=name or settings.name, storage=storage.optuna, pruner=pruner)


def make_study(storage: Storage, settings: StudySettings, fixed: Mapping[str, Any]) -> optuna.Study:
    """Makes a study, or finds the one that exists.

    Args:
        storage: that it is or will be in.
        settings: of it.
        fixed: the configuration of its trials, without what they try.

    Raises:
        StudyError: if the study that exists searches another space, has other objectives, or has trials with another
            configuration.
    """
    wanted: dict[str, Any] = {
        SPACE: settings.space.plain(),
        DASHBOARD_OBJECTIVES: dict(settings.objectives),
        FIXED: compared(fixed, settings)
        | {"study.seeds": list(settings.seeds), "study.task": settings.task["_target_"]},
    }

    def make() -> None:
        if settings.name in optuna.get_all_study_names(storage.optuna):
            return
        study = optuna.create_study(
            study_name=settings.name,
            storage=storage.optuna,
            directions=[StudyDirection[each.upper()] for each in settings.objectives.values()],
        )
        for key, value in wanted.items():
            study.set_user_attr(key, value)

    storage.alone(make)
    study = open_study(storage, settings)
    _check_same(settings, study, wanted)
    return study


def compared(config: Mapping[str, Any], settings: StudySettings) -> dict[str, Any]:
    """Returns the leaves of a configuration that trials of one study have in common."""
    searched = {parameter.name for parameter in settings.space.parameters}
    left_out = (*NOT_COMPARED, *searched)
    return {
        key: value
        for key, value in flattened(config).items()
        if not any(key == each or key.startswith(f"{each}.") for each in left_out)
    }


def _check_same(settings: StudySettings, study: optuna.Study, wanted: Mapping[str, Any]) -> None:
    there = study.user_attrs
    whose = f"the study {settings.name} in {settings.storage if '://' not in settings.storage else 'its storage'}"
    other = "; give study.name another value"
    for key, what in ((SPACE, "searches another space"), (DASHBOARD_OBJECTIVES, "has other objectives")):
        if differences := _differences(there.get(key, {}), wanted[key]):
            raise StudyError(f"{whose} {what}: {differences}{other}")
    differences = _differences(there.get(FIXED, {}), wanted[FIXED])
    if differences and settings.accept_changes:
        study.set_user_attr(FIXED, wanted[FIXED])
    elif differences:
        raise StudyError(
            f"{whose} has trials with another configuration: {differences}; study.accept_changes=true goes on all the "
            f"same{other}"
        )


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    keys = [key for key in {**before, **now} if before.get(key) != now.get(key) or (key in before) != (key in now)]
    shown = [f"{key} was {before.get(key, 'not there')}, is {now.get(key, 'not there')}" for key in keys[:N_SHOWN]]
    return ", ".join(shown) + (f", and {len(keys) - N_SHOWN} others" if len(keys) > N_SHOWN else "")

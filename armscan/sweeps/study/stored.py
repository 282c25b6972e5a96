"""Check the attributes and values of a stored study when it is opened: a stranger may have written them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Annotated, Any

import optuna
from optuna.trial import FrozenTrial, TrialState
from pydantic import ConfigDict, Field

from armscan.errors import ArmscanError, StudyError, few
from armscan.sweeps.scheduling.state import FINAL_SEED, FINALIST, METRICS
from armscan.sweeps.space.section import Section
from armscan.utils.validation import LARGEST_SEED

# SQLite's largest whole number.
LARGEST = 2**63 - 1
Number = Annotated[int, Field(ge=0, le=LARGEST, description="a whole number of at least 0")]
# Without what no path can have.
Text = Annotated[str, Field(pattern=r"^[^\x00]*$", description="a text")]


class _Attributes(Section):
    """User attributes; those of others are ignored."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)


class StudyAttributes(_Attributes):
    """User attributes of a study; the names are those of `armscan.sweeps.study.study` and of the scheduler."""

    space: dict[str, str] = Field(description="texts by the names of keys")
    fixed_config: dict[str, Any] = Field(description="values by the names of keys")
    objectives: dict[str, str] = Field(description="directions by the names of metrics")
    mlflow_run: Text = ""
    stop: Text = ""
    forgiven: list[Number] = Field(default=[], description="a list of numbers of trials")


class _Lease(_Attributes):
    worker: Text = ""
    host: Text = ""
    started: Text = ""
    directory: Text = ""
    boot: Text = ""
    pid_namespace: Text = ""
    pid: Number = 0
    beat: Number = 0
    seed: Number = 0
    env_steps: Number = 0
    mean_return: float = Field(default=0.0, alias="return", description="a number")


class TrialAttributes(_Attributes):
    """User attributes of a trial; the names are those of `armscan.sweeps.scheduling.state` and of `Attempt`."""

    lease: _Lease = Field(default=_Lease(), description="what a worker writes")
    env_steps: Number = 0
    figures: dict[str, float] = Field(default={}, description="numbers by their names")
    failure: Text = ""
    stop: Text = ""
    retried: bool = Field(default=False, description="true or false")
    retry_of: Number = 0
    attempt: Number = 0
    seeds: dict[Annotated[str, Field(pattern=r"^[0-9]{1,10}$")], dict[str, float]] = Field(
        default={}, description="the metrics of each seed"
    )
    judged: Number = 0
    judged_seed: int = Field(default=0, ge=0, le=LARGEST_SEED, description=f"a whole number from 0 to {LARGEST_SEED}")
    mlflow_run: Text = ""
    folder: Text = ""
    config_sha256: Text = ""


def check_trials(study: optuna.Study, *, n_searched: int | None = None) -> None:
    """Check that the trials of a study in its storage can be worked with.

    Args:
        study: the study.
        n_searched: number of trials of the search, if these are its final trainings. Default: None, the search itself.

    Raises:
        InvalidValueError: if a user attribute of a trial is of another type than armscan writes.
        StudyError: if Optuna cannot read the trials, or one lacks what it must have.
    """
    try:
        trials = study.get_trials(deepcopy=False)
    except ArmscanError:
        raise
    # Optuna's readers raise exceptions of many types on rows that Optuna has not written.
    except Exception as error:
        reason = " ".join(str(error).split()) or repr(error)
        raise StudyError(f"the trials of study {study.study_name!r} cannot be read: {reason[:300]}") from error
    for trial in trials:
        where = f"{study.study_name}.trials[{trial.number}]"
        TrialAttributes.read(f"{where}.user_attrs", trial.user_attrs)
        if wrong := _wrong_numbers(trial, len(study.directions)):
            raise StudyError(f"{where} {wrong}")
        if n_searched is not None:
            _check_final(trial, where, n_searched)


def _wrong_numbers(trial: FrozenTrial, n_objectives: int) -> str | None:
    """Return what is wrong with the values and reports of a trial; None if nothing is."""
    values: Sequence[Any] = trial.values or ()
    if trial.state == TrialState.COMPLETE and (len(values) != n_objectives or not all(map(_is_finite, values))):
        return f"has the values {few(map(repr, values)) or 'None'}, but it must have {n_objectives} finite numbers"
    for step, value in trial.intermediate_values.items():
        if type(step) is not int or not isinstance(value, Real):
            return f"has the report {step!r}: {value!r}, but it must be a number at a whole number"
    return None


def _is_finite(value: Any) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def _check_final(trial: FrozenTrial, where: str, n_searched: int) -> None:
    attributes = trial.user_attrs
    needed = [FINALIST, FINAL_SEED, *([METRICS] if trial.state == TrialState.COMPLETE else [])]
    if missing := [name for name in needed if name not in attributes]:
        raise StudyError(f"{where}.user_attrs has no {missing[0]}, as each final training has")
    if attributes[FINALIST] >= n_searched:
        raise StudyError(
            f"{where}.user_attrs.{FINALIST} is {attributes[FINALIST]}, but it must be the number of one of "
            f"{n_searched} trials"
        )

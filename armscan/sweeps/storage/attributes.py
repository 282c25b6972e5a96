"""Check the attributes and values of a stored study on each read: an untrusted storage may hold anything."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Annotated, Any

import optuna
from optuna.trial import FrozenTrial, TrialState
from pydantic import ConfigDict, Field

from armscan.errors import ArmscanError, StudyError, few, reason_of
from armscan.sweeps.storage.attribute_names import FINAL_SEED, FINALIST, METRICS, PARENT
from armscan.sweeps.storage.reports import REPORT
from armscan.utils.section import Section
from armscan.utils.validation import MAX_SEED, is_finite

# Suffixes to a study's name for the studies of its final trainings: those that select a configuration, and those that
# test it.
SELECTION_SUFFIX, TEST_SUFFIX = FINAL_SUFFIXES = ("-selection", "-judged")
# Errors that Optuna raises when it reads data that it has not written.
DAMAGED = (ValueError, TypeError, AttributeError, AssertionError)
UNREADABLE = (*DAMAGED, LookupError)
# SQLite's largest whole number.
LARGEST = 2**63 - 1
MAX_STEP_DIGITS = 18
Number = Annotated[int, Field(ge=0, le=LARGEST, description="a whole number of at least 0")]
TrialNumber = Annotated[str, Field(pattern=r"^[0-9]{1,10}$")]
# Until the year 5138.
Seconds = Annotated[float, Field(ge=0, le=1e11)]
# Excludes keys that name a class, such as `agent._target_`.
ScheduledKey = Annotated[str, Field(pattern=r"^(from_env_steps|agent\.[a-z]\w*)$")]
Segment = dict[ScheduledKey, bool | int | Annotated[float, Field(allow_inf_nan=False)]]
# Without null characters, which no path can have.
Text = Annotated[str, Field(pattern=r"^[^\x00]*$", description="a string")]


class _Attributes(Section):
    """User attributes; those of other programs are ignored."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)


class _Terminated(_Attributes):
    reason: Text = ""
    asked: Text = ""
    n_finished: Number = 0


class StudyAttributes(_Attributes):
    """User attributes of a study, named as in `attribute_names`."""

    space: dict[str, str] = Field(description="strings by the names of keys")
    fixed_config: dict[str, Any] = Field(description="values by the names of keys")
    objectives: dict[str, str] = Field(description="directions by the names of metrics")
    earlier_configs: dict[TrialNumber, dict[str, Any]] = Field(
        default={}, description="configurations by trial numbers"
    )
    mlflow_run: Text = ""
    begun_in: Text = ""
    note_sha256: Text = ""
    stop: Text = ""
    forgiven: list[Number] = Field(default=[], description="a list of numbers of trials")
    terminated: _Terminated = Field(default=_Terminated(), description="how the study has ended")
    begun_with: list[Text] = Field(default=[], description="a list of strings")


class _Lease(_Attributes):
    worker: Text = ""
    code: Text = ""
    host: Text = ""
    started: Text = ""
    directory: Text = ""
    boot: Text = ""
    pid_namespace: Text = ""
    pid: Number = 0
    beat: Number = 0
    beat_s: float = Field(default=0.0, description="a number")
    seed: Number = 0
    env_steps: Number = 0
    mean_return: float = Field(default=0.0, alias="return", description="a number")


class TrialAttributes(_Attributes):
    """User attributes of a trial, named as in `attribute_names`."""

    lease: _Lease = Field(default=_Lease(), description="what a worker writes")
    env_steps: Number = 0
    figures: dict[str, float] = Field(default={}, description="numbers by their names")
    failure: Text = ""
    stop: Text = ""
    pruned_at: Number = 0
    taken_from: Text = ""
    enqueued_from: Text = ""
    retried: bool = Field(default=False, description="true or false")
    dropped: bool = Field(default=False, description="true or false")
    retry_of: Number = 0
    attempt: Number = 0
    seeds: dict[Annotated[str, Field(pattern=r"^[0-9]{1,10}$")], dict[str, float]] = Field(
        default={}, description="the metrics of each seed"
    )
    earlier_spans: list[Annotated[list[Seconds], Field(min_length=2, max_length=2)]] = Field(
        default=[], description="pairs of seconds since 1970"
    )
    member: Number = 0
    generation: Number = 0
    interval: tuple[Number, Number] = Field(
        default=(0, 0), strict=False, description="two numbers of environment steps"
    )
    parent: Number = 0
    schedule: list[Segment] = Field(default=[], description="numbers and truth values by keys of agent")
    judged: int = Field(default=0, ge=-1, le=LARGEST, description="a whole number of at least 0, or -1 for the control")
    judged_seed: int = Field(default=0, ge=0, le=MAX_SEED, description=f"a whole number from 0 to {MAX_SEED}")
    mlflow_run: Text = ""
    folder: Text = ""
    config_sha256: Text = ""
    study_config_sha256: Text = ""


def check_trials(study: optuna.Study, *, n_searched: int | None = None) -> None:
    """Check that the trials of a stored study are valid.

    Args:
        study: Study to check.
        n_searched: Number of trials of the search, if these are its final trainings. Default: None, the search itself.

    Raises:
        InvalidValueError: If a user attribute of a trial is of another type than armscan writes.
        StudyError: If Optuna cannot read the trials, or one has invalid values or lacks a required attribute.
    """
    try:
        trials = study.get_trials(deepcopy=False)
    except ArmscanError:
        raise
    # Optuna's readers raise exceptions of many types on rows that Optuna has not written.
    except Exception as error:
        raise unreadable(f"study {study.study_name!r}", error) from error
    for trial in trials:
        check_trial(trial, study.study_name, len(study.directions))
        if n_searched is not None:
            _check_final(trial, place_of(study.study_name, trial), n_searched)


def check_trial(trial: FrozenTrial, study_name: str, n_objectives: int) -> None:
    """Check one trial; see `check_trials`.

    Args:
        trial: Trial to check.
        study_name: Name of its study.
        n_objectives: Number of values of a complete trial.
    """
    where = place_of(study_name, trial)
    TrialAttributes.read(f"{where}.user_attrs", trial.user_attrs)
    if trial.user_attrs.get(PARENT, -1) >= trial.number:
        raise StudyError(f"{where}.user_attrs.parent is {trial.user_attrs[PARENT]}, but it must be a trial before it")
    if wrong := _wrong_numbers(trial, n_objectives):
        raise StudyError(f"{where} {wrong}")
    if study_name.endswith(FINAL_SUFFIXES):
        _check_final(trial, where)


def place_of(study_name: str, trial: FrozenTrial) -> str:
    """Return the place of a trial in its storage, for messages."""
    return f"{study_name}.trials[{trial.number}]"


def unreadable(what: str, error: Exception) -> StudyError:
    """Return a one-line error: the trials of `what` cannot be read."""
    return StudyError(f"the trials of {what} cannot be read: {reason_of(error)}")


def _wrong_numbers(trial: FrozenTrial, n_objectives: int) -> str | None:
    """Return what is wrong with a trial's values or reports; None if nothing is."""
    values: Sequence[Any] = trial.values or ()
    if trial.state == TrialState.COMPLETE and (len(values) != n_objectives or not all(map(is_finite, values))):
        return f"has the values {few(map(repr, values)) or 'None'}, but it must have {n_objectives} finite numbers"
    for step, value in trial.intermediate_values.items():
        if type(step) is not int or not isinstance(value, Real):
            return f"has the report {step!r}: {value!r}, but it must be a number at a whole number"
    for name, reported in trial.system_attrs.items():
        if name.startswith(REPORT) and not _is_report(name.removeprefix(REPORT), reported, n_objectives):
            return f"has the system attribute {name}: {reported!r}, but it must be {n_objectives} numbers at a step"
    return None


def _is_report(step: str, values: Any, n_objectives: int) -> bool:
    is_step = step.isascii() and step.isdigit() and len(step) <= MAX_STEP_DIGITS
    is_list = isinstance(values, list) and len(values) == n_objectives
    return is_step and is_list and all(type(value) in (int, float) for value in values)


def _check_final(trial: FrozenTrial, where: str, n_searched: int | None = None) -> None:
    attributes = trial.user_attrs
    needed = [FINALIST, FINAL_SEED, *([METRICS] if trial.state == TrialState.COMPLETE else [])]
    if missing := [name for name in needed if name not in attributes]:
        raise StudyError(f"{where}.user_attrs lacks {missing[0]}, which each final training has")
    if n_searched is not None and attributes[FINALIST] >= n_searched:
        raise StudyError(
            f"{where}.user_attrs.{FINALIST} is {attributes[FINALIST]}, but it must be -1 for the control, "
            f"or the number of one of {n_searched} trials"
        )

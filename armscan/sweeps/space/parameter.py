"""A dimension of a search space, and its values as Optuna stores them and as the command line has them."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Self

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import BaseTrial
from pydantic import AfterValidator, Field

from armscan.config.defaults import NOT_SEARCHED
from armscan.config.legacy import renamed
from armscan.config.literal import hydra_literal
from armscan.errors import InvalidValueError, reason_of
from armscan.utils.section import Section

KEY = re.compile(r"[A-Za-z_][\w/]*(\.\w+)*")
Value = bool | int | float | str | None
Number = int | Annotated[float, Field(allow_inf_nan=False)]


def _kept(choices: list[Any]) -> list[Any]:
    kept = [optuna_value(each) for each in choices]
    if len(set(map(repr, kept))) < max(1, len(kept)):
        raise ValueError
    return kept


class _Searched(Section):
    when: dict[str, Any] | None = Field(default=None, min_length=1, description="choices of other keys, by their names")


class _Range(_Searched):
    low: Number = Field(description="a finite number")
    high: Number = Field(description="a finite number")
    log: bool = Field(default=False, description="true or false")
    step: Number | None = Field(default=None, description="a finite number")

    def distribution(self) -> BaseDistribution:
        given = {key: value for key in ("low", "high", "step") if (value := getattr(self, key)) is not None}
        kind: Any = IntDistribution if all(isinstance(each, int) for each in given.values()) else FloatDistribution
        with warnings.catch_warnings():
            # Optuna warns if the steps do not meet the upper end.
            warnings.simplefilter("error")
            made: BaseDistribution = kind(**given, log=self.log)
        return made


class _Choices(_Searched):
    choices: Annotated[list[Any], AfterValidator(_kept)] = Field(description="a list of values, none of them twice")

    def distribution(self) -> BaseDistribution:
        return CategoricalDistribution(self.choices)


@dataclass(frozen=True)
class Parameter:
    """One dimension of a search space.

    Args:
        name: Key or group of the configuration.
        distribution: Range or choices.
        when: Required choices of earlier parameters, by their names; it is searched only if all of them hold.
    """

    name: str
    distribution: BaseDistribution
    when: Mapping[str, tuple[Value, ...]] = field(default_factory=dict)

    @classmethod
    def read(cls, name: str, described: Any) -> Self:
        """Return the parameter of a description such as `{low: 1e-4, high: 1e-2, log: true}` or `{choices: [a, b]}`."""
        where = f"study.space.{name}"
        if isinstance(described, Mapping):
            # The command line removes a key by setting it to null.
            described = {key: value for key, value in described.items() if value is not None}
        if not KEY.fullmatch(name):
            raise InvalidValueError(f"{where}: {name!r} is not a key of the configuration, such as agent.lr")
        if re.split("[/.]", name)[0] in NOT_SEARCHED:
            raise InvalidValueError(
                f"{where}: {name!r} sets how a study is run, evaluated or stored, so it cannot be searched"
            )
        if not isinstance(described, Mapping) or ("choices" in described) is bool({"low", "high"} & described.keys()):
            raise InvalidValueError(
                f"{where} is {described!r}, but it must have low and high, or choices: {where}.choices=[...] on the "
                "command line replaces a range"
            )
        read = (_Choices if "choices" in described else _Range).read(where, described)
        if isinstance(read, _Range) and read.log and not read.low > 0:
            raise InvalidValueError(f"{where}.low is {read.low}, but it must be above 0, because log is true")
        try:
            distribution = read.distribution()
        except (ValueError, UserWarning) as error:
            raise InvalidValueError(f"{where}: {error}") from error
        several = {key: each if isinstance(each, list) else [each] for key, each in (read.when or {}).items()}
        return cls(name, distribution, {key: tuple(map(optuna_value, values)) for key, values in several.items()})

    def applies(self, chosen: Mapping[str, Value]) -> bool:
        """Return whether it is searched, given the values that were chosen before."""
        return all(name in chosen and chosen[name] in values for name, values in self.when.items())

    def matching(self, value: Any) -> tuple[Value, ...]:
        """Return a value, as Optuna stores it, if it lies in its range; or its choice that equals it; else nothing."""
        drawn: Any = self.distribution
        if isinstance(drawn, CategoricalDistribution):
            # 1 is 1.0, but not true.
            choices = (each for each in drawn.choices if isinstance(value, bool) == isinstance(each, bool))
            return tuple(each for each in choices if each == value)[:1]
        whole = isinstance(drawn, IntDistribution)
        is_inside = type(value) in ((int,) if whole else (int, float)) and bool(drawn._contains(value))
        return (value,) if is_inside else ()

    def nearest(self, value: Any) -> tuple[Value, ...]:
        """Return a value if it lies in its range or equals a choice; else the nearest one to a number, or nothing.

        Of several choices it is the nearest by ratio, as learning rates are compared, if all are positive.
        """
        drawn: Any = self.distribution
        if (match := self.matching(value)) or not _is_finite(value):
            return match
        if isinstance(drawn, CategoricalDistribution):
            numbers: list[Any] = [each for each in drawn.choices if _is_finite(each)]
            scale = math.log if all(each > 0 for each in (value, *numbers)) else float
            return tuple(sorted(numbers, key=lambda each: abs(scale(each) - scale(value))))[:1]
        inside = min(max(value, drawn.low), drawn.high)
        if drawn.step:
            # A sum of steps may exceed the upper end by a rounding error, which the space would refuse.
            inside = min(drawn.low + round((inside - drawn.low) / drawn.step) * drawn.step, drawn.high)
        return (inside,)

    def suggest(self, trial: BaseTrial) -> Value:
        """Return the value of a trial.

        Raises:
            InvalidValueError: If its value in the storage is not in the space.
        """
        drawn: Any = self.distribution
        refused = f"{self.name} has a value in the study's storage that is not in study.space"
        try:
            if isinstance(drawn, CategoricalDistribution):
                choice: Value = trial.suggest_categorical(self.name, drawn.choices)
                return choice
            suggest: Any = trial.suggest_int if isinstance(drawn, IntDistribution) else trial.suggest_float
            number: float = suggest(self.name, drawn.low, drawn.high, log=drawn.log, step=drawn.step)
        except (ValueError, TypeError) as error:
            raise InvalidValueError(f"{refused}, or study.sampler has failed: {reason_of(error)}") from error
        # Optuna accepts any value of an enqueued trial, and warns.
        if type(number) not in (int, float) or not drawn._contains(number):
            raise InvalidValueError(f"{refused}: {number!r}")
        return number

    @property
    def extremes(self) -> tuple[Value, ...]:
        """The values to check, as all are allowed if these are: every choice, or both ends of the range."""
        drawn: Any = self.distribution
        return tuple(drawn.choices) if isinstance(drawn, CategoricalDistribution) else (drawn.low, drawn.high)


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def optuna_value(value: Any) -> Value:
    """Return a value as Optuna stores it; a list or mapping becomes the string that Hydra reads."""
    kept: Value = hydra_literal(value) if isinstance(value, list | tuple | Mapping) else value
    return kept


def overrides_of(chosen: Mapping[str, Value]) -> list[str]:
    """Return values as overrides of the command line; keys of earlier versions get their new names."""
    return [f"{name}={hydra_literal(value)}" for name, value in renamed(chosen).items()]


def rounded_overrides(chosen: Mapping[str, Value]) -> list[str]:
    """Return values as overrides with four significant digits, for tables."""
    return overrides_of(
        {key: float(f"{each:.4g}") if isinstance(each, float) else each for key, each in chosen.items()}
    )


def describe(distribution: BaseDistribution) -> str:
    """Return a range or choices in words, such as `0.001 to 0.1, log`."""
    drawn: Any = distribution
    if isinstance(drawn, CategoricalDistribution):
        return ", ".join(map(str, drawn.choices))
    is_whole = isinstance(drawn, IntDistribution)
    # `g` would round large integers.
    form = "d" if is_whole else "g"
    how = ", whole" if is_whole else ""
    how += ", log" if drawn.log else ""
    how += f", in steps of {drawn.step:{form}}" if drawn.step is not None and not (is_whole and drawn.step == 1) else ""
    return f"{drawn.low:{form}} to {drawn.high:{form}}{how}"

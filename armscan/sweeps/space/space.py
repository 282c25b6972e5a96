"""What a study searches: keys and groups of the configuration, each with its range or its choices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
    distribution_to_json,
)
from optuna.trial import BaseTrial

from armscan.errors import InvalidValueError, listed
from armscan.sweeps.space.overrides import Value, as_kept
from armscan.sweeps.space.parse import by_key, read_description


@dataclass(frozen=True)
class Parameter:
    """One dimension of a search space.

    Args:
        name: the key or group of the configuration.
        distribution: its range or its choices.
        when: the choices of parameters before it that it needs, by their names; it is searched only where all hold.
    """

    name: str
    distribution: BaseDistribution
    when: Mapping[str, tuple[Value, ...]] = field(default_factory=dict)

    @classmethod
    def read(cls, name: str, described: Any) -> Self:
        """Return the parameter of a description such as `{low: 1e-4, high: 1e-2, log: true}` or `{choices: [a, b]}`.

        Raises:
            InvalidValueError: if it describes none.
        """
        distribution, when = read_description(name, described)
        return cls(name, distribution, when)

    def applies(self, chosen: Mapping[str, Value]) -> bool:
        """Whether it is searched where these values were chosen before."""
        return all(name in chosen and chosen[name] in values for name, values in self.when.items())

    def suggest(self, trial: BaseTrial) -> Value:
        """Return the value of a trial."""
        distribution = self.distribution
        if isinstance(distribution, CategoricalDistribution):
            choice: Value = trial.suggest_categorical(self.name, distribution.choices)
            return choice
        if isinstance(distribution, IntDistribution):
            return trial.suggest_int(
                self.name, distribution.low, distribution.high, log=distribution.log, step=distribution.step
            )
        assert isinstance(distribution, FloatDistribution)
        return trial.suggest_float(
            self.name, distribution.low, distribution.high, log=distribution.log, step=distribution.step
        )

    def extremes(self) -> tuple[Value, ...]:
        """Return the values that have to be allowed for all of them to be."""
        distribution = self.distribution
        if isinstance(distribution, CategoricalDistribution):
            return tuple(distribution.choices)
        assert isinstance(distribution, FloatDistribution | IntDistribution)
        return distribution.low, distribution.high


@dataclass(frozen=True)
class Space:
    """A search space.

    Args:
        parameters: in the order in which they are chosen.
    """

    parameters: tuple[Parameter, ...]

    @classmethod
    def read(cls, described: Any) -> Self:
        """Return the space of a mapping from keys of the configuration to descriptions.

        Raises:
            InvalidValueError: if it describes none.
        """
        if not isinstance(described, Mapping) or not described:
            raise InvalidValueError(f"study.space is {described!r}, but it must have at least one key to search")
        parameters = tuple(Parameter.read(name, each) for name, each in by_key(described).items())
        before: dict[str, tuple[Value, ...]] = {}
        for parameter in parameters:
            for name, values in parameter.when.items():
                if name not in before:
                    raise InvalidValueError(
                        f"study.space.{parameter.name}.when names {name!r}, but it must be a key with choices above it"
                        + (f": {listed(before)}" if before else "")
                    )
                if wrong := [value for value in values if value not in before[name]]:
                    where = f"study.space.{parameter.name}.when.{name}"
                    raise InvalidValueError(f"{where} is {wrong[0]!r}, but it must be {listed(before[name])}")
            if isinstance(parameter.distribution, CategoricalDistribution):
                before[parameter.name] = tuple(parameter.distribution.choices)
        space = cls(parameters)
        for parameter in parameters:
            if space._with_needs({parameter.name: parameter.extremes()[0]}) is None:
                raise InvalidValueError(f"study.space.{parameter.name}.when can never hold, for what its keys need")
        return space

    def suggest(self, trial: BaseTrial) -> dict[str, Value]:
        """Return the values of a trial by name."""
        chosen: dict[str, Value] = {}
        for parameter in self.parameters:
            if parameter.applies(chosen):
                chosen[parameter.name] = parameter.suggest(trial)
        return chosen

    def extremes(self) -> Iterator[dict[str, Value]]:
        """Yield values by name that between them have every choice and both ends of every range.

        Where a parameter needs choices of others, these stand with it.
        """
        for parameter in self.parameters:
            for value in parameter.extremes():
                chosen = self._with_needs({parameter.name: value})
                assert chosen is not None
                yield chosen

    def completed(self, chosen: Mapping[str, Value]) -> dict[str, Value]:
        """Return choices with a value of every other parameter that is searched beside them, as a trial has them."""
        complete: dict[str, Value] = {}
        for parameter in self.parameters:
            if parameter.name in chosen or parameter.applies(complete):
                complete[parameter.name] = chosen.get(parameter.name, parameter.extremes()[0])
        return complete

    def _with_needs(self, chosen: Mapping[str, Value]) -> dict[str, Value] | None:
        """Return choices with those that they need beside them, None where no choice is allowed by all."""
        for parameter in self.parameters:
            if parameter.name not in chosen:
                continue
            for name, values in parameter.when.items():
                if name not in chosen:
                    tried = (self._with_needs({name: value, **chosen}) for value in values)
                    return next((each for each in tried if each is not None), None)
                if chosen[name] not in values:
                    return None
        return dict(chosen)

    def without(self, fixed: Mapping[str, Any]) -> Space:
        """Return the space without keys that somebody has given values, and without what needs other values."""
        kept: dict[str, Parameter] = {}
        for each in self.parameters:
            can_apply = all(
                as_kept(fixed[name]) in values if name in fixed else name in kept for name, values in each.when.items()
            )
            if each.name not in fixed and can_apply:
                open_yet = {name: values for name, values in each.when.items() if name not in fixed}
                kept[each.name] = replace(each, when=open_yet)
        return Space(tuple(kept.values()))

    def to_plain(self) -> dict[str, str]:
        """Return the space in a form that can be compared and kept."""
        return {
            each.name: distribution_to_json(each.distribution) + (f" when {dict(each.when)}" if each.when else "")
            for each in self.parameters
        }

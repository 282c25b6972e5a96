"""Search space of a study: keys and groups of the configuration, each with its range or its choices."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from optuna.distributions import CategoricalDistribution, distribution_to_json, json_to_distribution
from optuna.trial import BaseTrial

from armscan.config.literal import hydra_literal
from armscan.errors import InvalidValueError, listed
from armscan.sweeps.space.parameter import Parameter, Value, describe, optuna_value


@dataclass(frozen=True)
class Space:
    """A search space: its parameters, in the order in which they are chosen."""

    parameters: tuple[Parameter, ...]

    @classmethod
    def read(cls, described: Any) -> Self:
        """Return the space of a mapping from keys of the configuration to descriptions; null removes a key."""
        if not isinstance(described, Mapping) or not described:
            raise InvalidValueError(f"study.space is {described!r}, but it must have at least one key to search")
        space = cls(tuple(Parameter.read(name, each) for name, each in described.items() if each is not None))
        above: dict[str, tuple[Value, ...]] = {}
        for parameter in space.parameters:
            where = f"study.space.{parameter.name}.when"
            for name, values in parameter.when.items():
                if name not in above:
                    keys = f": {listed(above)}" if above else ""
                    raise InvalidValueError(f"{where} names {name!r}, but it must be a key with choices above it{keys}")
                if wrong := [value for value in values if value not in above[name]]:
                    raise InvalidValueError(f"{where}.{name} is {wrong[0]!r}, but it must be {listed(above[name])}")
            if space._with_needs(parameter.name, None) is None:
                raise InvalidValueError(f"{where} can never apply, because of what its keys require")
            if isinstance(parameter.distribution, CategoricalDistribution):
                above[parameter.name] = parameter.extremes
        return space

    def suggest(self, trial: BaseTrial) -> dict[str, Value]:
        """Return the values of a trial by name."""
        chosen: dict[str, Value] = {}
        for parameter in self.parameters:
            if parameter.applies(chosen):
                chosen[parameter.name] = parameter.suggest(trial)
        return chosen

    def fit(self, values: Mapping[str, Value], *, nearest: bool = False) -> tuple[dict[str, Value], str | None]:
        """Return the values of a trial that lie in the space, and the first misfit.

        Args:
            values: Values by name, as Optuna stores them; those of other keys are left out.
            nearest: Whether a number outside of the space is replaced by the nearest value in it, and values may be
                missing. Default: False.

        Returns:
            The values of the parameters that apply; and a message about the first that is missing or lies outside, None
            if none is.
        """
        chosen: dict[str, Value] = {}
        misfit = None
        for parameter in self.parameters:
            name = parameter.name
            if not parameter.applies(chosen):
                continue
            match = parameter.nearest if nearest else parameter.matching
            if name in values and (matches := match(values[name])):
                (chosen[name],) = matches
            elif misfit is None and (name in values or not nearest):
                value = f"{name}={hydra_literal(values[name])}" if name in values else f"{name} has no value and"
                misfit = f"{value} is not in the space"
        return chosen, misfit

    def extremes(self) -> Iterator[dict[str, Value]]:
        """Yield sets of values by name that together cover every choice and both ends of every range.

        Each of these values comes last in its set, after the choices of other parameters that it requires.
        """
        for parameter in self.parameters:
            for value in parameter.extremes:
                chosen = self._with_needs(parameter.name, value)
                assert chosen is not None
                yield chosen

    def completed(self, chosen: Mapping[str, Value]) -> dict[str, Value]:
        """Return choices with a value of every other parameter that is searched with them, as in a trial."""
        complete: dict[str, Value] = {}
        for parameter in self.parameters:
            if parameter.name in chosen or parameter.applies(complete):
                complete[parameter.name] = chosen.get(parameter.name, parameter.extremes[0])
        return complete

    def _with_needs(self, name: str, value: Value) -> dict[str, Value] | None:
        """Return a value after the choices that it requires; None if these exclude each other."""
        allowed: dict[str, tuple[Value, ...]] = {name: (value,)}
        for parameter in reversed(self.parameters):
            for needed, values in parameter.when.items() if parameter.name in allowed else ():
                allowed[needed] = tuple(each for each in allowed.get(needed, values) if each in values)
        if not all(allowed.values()):
            return None
        return {each: values[0] for each, values in reversed(allowed.items())}

    def without(self, fixed: Mapping[str, Any]) -> Space:
        """Return the space without keys that have fixed values, and without keys that require other values."""
        kept: dict[str, Parameter] = {}
        for each in self.parameters:
            can_apply = all(
                optuna_value(fixed[name]) in values if name in fixed else name in kept
                for name, values in each.when.items()
            )
            if each.name not in fixed and can_apply:
                open_yet = {name: values for name, values in each.when.items() if name not in fixed}
                kept[each.name] = replace(each, when=open_yet)
        return Space(tuple(kept.values()))

    def to_plain(self) -> dict[str, str]:
        """Return the space as strings that can be stored and compared."""
        return {
            each.name: distribution_to_json(each.distribution) + (f" when {dict(each.when)}" if each.when else "")
            for each in self.parameters
        }


def in_words(described: Mapping[str, str]) -> dict[str, str]:
    """Return a space of `Space.to_plain` with each range and its choices in words."""
    return {name: _in_words(text) for name, text in described.items()}


def _in_words(text: str) -> str:
    try:
        _, end = json.JSONDecoder().raw_decode(text)
        return describe(json_to_distribution(text[:end])) + text[end:]
    # A damaged storage.
    except (ValueError, KeyError, TypeError):
        return text


def is_conditional(described: str) -> bool:
    """Return whether a key, as `Space.to_plain` describes it, is searched only beside certain choices."""
    # Of the JSON of a distribution, the last characters are `}}`; of a condition, whose values are a tuple, `)}`.
    return not described.endswith("}}")

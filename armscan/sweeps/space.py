"""What a study searches: keys and groups of the configuration, each with its range or its choices."""

from __future__ import annotations

import re
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

from armscan.checks import check_bool, check_float, check_int
from armscan.errors import InvalidValueError, listed
from armscan.sweeps.values import Value, as_kept

RANGE_KEYS, CHOICE_KEYS = ("low", "high", "log", "step", "when"), ("choices", "when")
# Of one step: what decimal fractions are off in binary ones.
STEP_TOLERANCE = 1e-6
OWN_KEYS = {*RANGE_KEYS, *CHOICE_KEYS}
# Whatever begins with one of these.
NOT_SEARCHED = ("study", "sweeps", "tracking", "hydra", "seed")
KEY = re.compile(r"[A-Za-z_][\w/]*(\.\w+)*")


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
        """Returns the parameter of a description such as `{low: 1e-4, high: 1e-2, log: true}` or `{choices: [a, b]}`.

        Raises:
            InvalidValueError: if it describes none.
        """
        where = f"study.space.{name}"
        if not KEY.fullmatch(name):
            raise InvalidValueError(f"{where}: {name!r} is no key of the configuration, such as agent.lr")
        if name.partition("/")[0].partition(".")[0] in NOT_SEARCHED:
            raise InvalidValueError(f"{where}: {name!r} says how a study is run or kept, which no trial can try")
        if not isinstance(described, Mapping) or not ({"low", "high"} <= described.keys() or "choices" in described):
            raise InvalidValueError(f"{where} is {described!r}, but it must have low and high, or choices")
        if "choices" in described and {"low", "high"} & described.keys():
            raise InvalidValueError(
                f"{where} is {described!r}, but it must have low and high, or choices: {where}.choices=[...] on the "
                "command line replaces a range"
            )
        allowed = CHOICE_KEYS if "choices" in described else RANGE_KEYS
        if unknown := [key for key in described if key not in allowed]:
            raise InvalidValueError(f"there is no key {unknown[0]!r} in {where}, but only {listed(allowed)}")
        read = _choices if "choices" in described else _range
        return cls(name, read(where, described), _conditions(where, described.get("when")))

    def applies(self, chosen: Mapping[str, Value]) -> bool:
        """Whether it is searched where these values were chosen before."""
        return all(name in chosen and chosen[name] in values for name, values in self.when.items())

    def suggest(self, trial: BaseTrial) -> Value:
        """Returns the value of a trial."""
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
        """Returns the values that have to be allowed for all of them to be."""
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
        """Returns the space of a mapping from keys of the configuration to descriptions.

        Raises:
            InvalidValueError: if it describes none.
        """
        if not isinstance(described, Mapping) or not described:
            raise InvalidValueError(f"study.space is {described!r}, but it must have at least one key to search")
        parameters = tuple(Parameter.read(name, each) for name, each in _by_key(described).items())
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
        """Returns the values of a trial by name."""
        chosen: dict[str, Value] = {}
        for parameter in self.parameters:
            if parameter.applies(chosen):
                chosen[parameter.name] = parameter.suggest(trial)
        return chosen

    def extremes(self) -> Iterator[dict[str, Value]]:
        """Yields values by name that between them have every choice and both ends of every range.

        Where a parameter needs choices of others, these stand with it.
        """
        for parameter in self.parameters:
            for value in parameter.extremes():
                chosen = self._with_needs({parameter.name: value})
                assert chosen is not None
                yield chosen

    def completed(self, chosen: Mapping[str, Value]) -> dict[str, Value]:
        """Returns choices with a value of every other parameter that is searched beside them, as a trial has them."""
        complete: dict[str, Value] = {}
        for parameter in self.parameters:
            if parameter.name in chosen or parameter.applies(complete):
                complete[parameter.name] = chosen.get(parameter.name, parameter.extremes()[0])
        return complete

    def _with_needs(self, chosen: Mapping[str, Value]) -> dict[str, Value] | None:
        """Returns choices with those that they need beside them, None where no choice is allowed by all."""
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
        """Returns the space without keys that somebody has given values, and without what needs other values."""
        kept: dict[str, Parameter] = {}
        for each in self.parameters:
            can_apply = all(
                as_kept(fixed[name]) in values if name in fixed else name in kept for name, values in each.when.items()
            )
            if each.name not in fixed and can_apply:
                open_yet = {name: values for name, values in each.when.items() if name not in fixed}
                kept[each.name] = replace(each, when=open_yet)
        return Space(tuple(kept.values()))

    def plain(self) -> dict[str, str]:
        """Returns the space in a form that can be compared and kept."""
        return {
            each.name: distribution_to_json(each.distribution) + (f" when {dict(each.when)}" if each.when else "")
            for each in self.parameters
        }


def _by_key(described: Mapping[str, Any]) -> dict[str, Any]:
    """Returns descriptions by key, also of those that stand inside others, as the command line has them.

    Of two for one key the later counts: as far as it goes for a range, as a whole for choices; null takes a key out.
    """
    by_key: dict[str, Any] = {}
    for name, later in _in_order(described, ""):
        before = by_key.get(name)
        if isinstance(before, Mapping) and isinstance(later, Mapping):
            kept = {key: each for key, each in before.items() if key == "when" or "choices" not in later}
            by_key[name] = {**kept, **later}
        else:
            by_key[name] = later
    return {name: each for name, each in by_key.items() if each is not None}


def _in_order(described: Mapping[str, Any], above: str) -> Iterator[tuple[str, Any]]:
    for name, each in described.items():
        key, inside = f"{above}{name}", {}
        if isinstance(each, Mapping):
            inside = {at: one for at, one in each.items() if at not in OWN_KEYS and isinstance(one, Mapping | None)}
            each = {at: one for at, one in each.items() if at not in inside}
        if each or not inside:
            yield key, each
        yield from _in_order(inside, f"{key}.")


def _choices(where: str, described: Mapping[str, Any]) -> CategoricalDistribution:
    choices = described["choices"]
    if not isinstance(choices, list | tuple) or not choices:
        raise InvalidValueError(f"{where}.choices is {choices!r}, but it must be a list of at least one value")
    texts = [as_kept(each) for each in choices]
    if len(set(map(repr, texts))) < len(texts):
        raise InvalidValueError(f"{where}.choices is {choices!r}, but no value may be there twice")
    return CategoricalDistribution(texts)


def _range(where: str, described: Mapping[str, Any]) -> BaseDistribution:
    low, high, step = described["low"], described["high"], described.get("step")
    log = check_bool(f"{where}.log", described.get("log", False))
    is_whole = all(isinstance(each, int) and not isinstance(each, bool) for each in (low, high))
    low, high = check_float(f"{where}.low", low), check_float(f"{where}.high", high)
    if low >= high:
        raise InvalidValueError(f"{where}.low is {low:g}, but it must be below high, {high:g}")
    if log and low <= 0:
        raise InvalidValueError(f"{where}.low is {low:g}, but it must be above 0 where log is true")
    if log and step is not None:
        raise InvalidValueError(f"{where}.step is {step!r}, but a range with log has no step")
    if is_whole:
        size = 1 if step is None else check_int(f"{where}.step", step, at_least=1, at_most=int(high - low))
        _check_steps(where, low, high, size)
        return IntDistribution(int(low), int(high), log=log, step=size)
    size_of_step = None if step is None else check_float(f"{where}.step", step, above=0.0, at_most=high - low)
    _check_steps(where, low, high, size_of_step)
    return FloatDistribution(low, high, log=log, step=size_of_step)


def _check_steps(where: str, low: float, high: float, step: float | None) -> None:
    """Raises `InvalidValueError` where steps from the lower end do not meet the upper one."""
    n_steps = (high - low) / (step or 1.0)
    if step is not None and abs(n_steps - round(n_steps)) > STEP_TOLERANCE:
        last = low + int(n_steps) * step
        raise InvalidValueError(f"{where}.high is {high:g}, but steps of {step:g} from {low:g} end at {last:g}")


def _conditions(where: str, when: Any) -> dict[str, tuple[Value, ...]]:
    if when is None:
        return {}
    if not isinstance(when, Mapping) or not when:
        raise InvalidValueError(f"{where}.when is {when!r}, but it must say which choice of which key is needed")
    several = {name: values if isinstance(values, list | tuple) else [values] for name, values in when.items()}
    if empty := [name for name, values in several.items() if not values]:
        raise InvalidValueError(f"{where}.when.{empty[0]} is [], but it must be a choice, or a list of several")
    return {str(name): tuple(map(as_kept, values)) for name, values in several.items()}

"""How a search space is written down: what stands for one key, and where the command line changes it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from armscan.errors import InvalidValueError, listed
from armscan.sweeps.space.overrides import Value, as_kept
from armscan.utils.validation import check_bool, check_float, check_int

RANGE_KEYS, CHOICE_KEYS = ("low", "high", "log", "step", "when"), ("choices", "when")
OWN_KEYS = {*RANGE_KEYS, *CHOICE_KEYS}
# Of one step: what decimal fractions are off in binary ones.
STEP_TOLERANCE = 1e-6
# Whatever begins with one of these.
NOT_SEARCHED = ("study", "sweep", "tracking", "hydra", "seed")
KEY = re.compile(r"[A-Za-z_][\w/]*(\.\w+)*")


def by_key(described: Mapping[str, Any]) -> dict[str, Any]:
    """Return descriptions by key, also of those that stand inside others, as the command line has them.

    Of two for one key the later counts: as far as it goes for a range, as a whole for choices; null takes a key out.
    """
    found: dict[str, Any] = {}
    for name, later in _in_order(described, ""):
        before = found.get(name)
        if isinstance(before, Mapping) and isinstance(later, Mapping):
            kept = {key: each for key, each in before.items() if key == "when" or "choices" not in later}
            found[name] = {**kept, **later}
        else:
            found[name] = later
    return {name: each for name, each in found.items() if each is not None}


def _in_order(described: Mapping[str, Any], above: str) -> Iterator[tuple[str, Any]]:
    for name, each in described.items():
        key, inside = f"{above}{name}", {}
        if isinstance(each, Mapping):
            inside = {at: one for at, one in each.items() if at not in OWN_KEYS and isinstance(one, Mapping | None)}
            each = {at: one for at, one in each.items() if at not in inside}
        if each or not inside:
            yield key, each
        yield from _in_order(inside, f"{key}.")


def read_description(name: str, described: Any) -> tuple[BaseDistribution, dict[str, tuple[Value, ...]]]:
    """Return what a description says of one key: its range or choices, and which choices of others it needs.

    Args:
        name: of the key.
        described: such as `{low: 1e-4, high: 1e-2, log: true}` or `{choices: [a, b]}`.

    Raises:
        InvalidValueError: if it describes nothing that can be searched.
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
    return read(where, described), _conditions(where, described.get("when"))


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
    """Raise `InvalidValueError` where steps from the lower end do not meet the upper one."""
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

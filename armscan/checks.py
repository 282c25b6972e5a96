"""Checks of arguments that constructors share: each returns the value or raises `InvalidValueError`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, TypeVar

from armscan.errors import InvalidValueError, listed

T = TypeVar("T")


def check_int(name: str, value: Any, *, at_least: int) -> int:
    """Returns `value` as an int if it is a whole number of at least `at_least`."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < at_least:
        raise InvalidValueError(f"{name} is {value!r}, but it must be a whole number of at least {at_least}")
    return int(value)


def check_float(
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
) -> float:
    """Returns `value` as a float if it is finite and inside the given bounds."""
    bounds = [
        f"{word} {bound:g}"
        for word, bound in (("above", above), ("at least", at_least), ("at most", at_most))
        if math.isfinite(bound)
    ]
    is_number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not is_number or value <= above or value < at_least or value > at_most:
        raise InvalidValueError(f"{name} is {value!r}, but it must be a finite number {' and '.join(bounds)}".rstrip())
    return float(value)


def check_bool(name: str, value: Any) -> bool:
    """Returns `value` if it is a bool."""
    if not isinstance(value, bool):
        raise InvalidValueError(f"{name} is {value!r}, but it must be true or false")
    return value


def check_choice(name: str, value: T, allowed: Sequence[T]) -> T:
    """Returns `value` if it is one of `allowed`."""
    if value not in allowed:
        raise InvalidValueError(f"{name} is {value!r}, but it must be {listed(allowed)}")
    return value


def check_numbers(name: str, value: Any, length: int, meaning: str) -> tuple[float, ...]:
    """Returns `value` as a tuple of `length` finite floats; `meaning` says of what: '(rz, rx) in degrees'."""
    try:
        numbers = tuple(float(number) for number in value)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != length or not all(map(math.isfinite, numbers)):
        raise InvalidValueError(f"{name} is {value!r}, but it must be {length} finite numbers, {meaning}")
    return numbers

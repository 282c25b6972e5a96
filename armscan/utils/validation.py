"""Checks of arguments that constructors share: each returns the value or raises `InvalidValueError`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from armscan.errors import InvalidValueError, listed

T = TypeVar("T")
# Within the range of seeds of every random generator in use.
MAX_SEED = 2**31 - 1


def check_int(name: str, value: Any, *, at_least: int, at_most: int | None = None) -> int:
    """Return a checked whole number.

    Args:
        name: Name of the argument, for errors.
        value: Value to check; truth values are refused.
        at_least: Smallest allowed value.
        at_most: Largest allowed value. Default: None, no limit.

    Raises:
        InvalidValueError: If the value is not a whole number within the bounds.
    """
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not is_whole or value < at_least or (at_most is not None and value > at_most):
        above = "" if at_most is None else f" and at most {at_most}"
        raise InvalidValueError(f"{name} is {value!r}, but it must be a whole number of at least {at_least}{above}")
    return int(value)


def check_seed(name: str, value: Any) -> int:
    """Return `value` if it can seed every random generator in use."""
    return check_int(name, value, at_least=0, at_most=MAX_SEED)


def check_float(
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
) -> float:
    """Return a checked finite number.

    Args:
        name: Name of the argument, for errors.
        value: Value to check; truth values are refused.
        above: Bound that the value must exceed. Default: none.
        at_least: Smallest allowed value. Default: no limit.
        at_most: Largest allowed value. Default: no limit.

    Raises:
        InvalidValueError: If the value is not a finite number within the bounds.
    """
    bounds = [
        f"{word} {bound:g}"
        for word, bound in (("above", above), ("at least", at_least), ("at most", at_most))
        if math.isfinite(bound)
    ]
    if not is_finite(value) or value <= above or value < at_least or value > at_most:
        raise InvalidValueError(f"{name} is {value!r}, but it must be a finite number {' and '.join(bounds)}".rstrip())
    return float(value)


def check_bool(name: str, value: Any) -> bool:
    """Return `value` if it is a truth value."""
    if not isinstance(value, bool):
        raise InvalidValueError(f"{name} is {value!r}, but it must be true or false")
    return value


def check_choice(name: str, value: T, allowed: Sequence[T]) -> T:
    """Return `value` if it is one of `allowed`."""
    # An array is never a choice, and cannot be compared with one.
    if isinstance(value, np.ndarray) or value not in allowed:
        raise InvalidValueError(f"{name} is {value!r}, but it must be {listed(allowed)}")
    return value


def check_numbers(name: str, value: Any, length: int, meaning: str) -> tuple[float, ...]:
    """Return `value` as a tuple of `length` finite floats; `meaning` describes them, such as '(rz, rx) in degrees'."""
    if type(value) is tuple and [type(number) for number in value] == [float] * length and math.isfinite(sum(value)):
        # The fast path of every environment step: the checks below cost more than the rest of its plane.
        return value
    is_sequence = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)
    if not is_sequence or len(value) != length or not all(map(is_finite, value)):
        raise InvalidValueError(f"{name} is {value!r}, but it must be {length} finite numbers, {meaning}")
    return tuple(float(number) for number in value)


def check_ints(
    name: str, value: Any, length: int | None, meaning: str, *, min_length: int = 0, **bounds: int
) -> tuple[int, ...]:
    """Return `value` as a tuple of `length` whole numbers, or of any number of them if `length` is None.

    Args:
        name: Name of the argument, for errors.
        value: Sequence to check; text and bytes are refused.
        length: Required number of values.
        meaning: Meaning of the values, such as '(across, depth)'.
        min_length: Smallest number of values, if `length` is None. Default: 0.
        **bounds: Bounds of each value; see `check_int`.
    """
    is_sequence = isinstance(value, Sequence) and not isinstance(value, str | bytes | bytearray | memoryview)
    if not is_sequence or len(value) < min_length or (length is not None and len(value) != length):
        wanted = f"a list of{f' {min_length} or more' if min_length else ''}" if length is None else str(length)
        raise InvalidValueError(f"{name} is {value!r}, but it must be {wanted} whole numbers{meaning and ' '}{meaning}")
    return tuple(check_int(f"each of {name}", number, **bounds) for number in value)


def check_path(name: str, value: Any) -> Path:
    """Return `value` as a path if it is a string or a path."""
    if not isinstance(value, str | Path) or value == "" or "\0" in str(value):
        raise InvalidValueError(f"{name} is {value!r}, but it must be the path of a file or folder")
    return Path(value)


def is_finite(value: Any) -> bool:
    """Return whether `value` is a finite number that fits a float, not a truth value."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False


def missing_members(made: object, protocol: type[Any]) -> list[str]:
    """Return the names of a protocol's members that an object lacks, in the order of the protocol."""
    names = [name for kind in reversed(protocol.__mro__) for name in vars(kind) if not name.startswith("_")]
    return [name for name in names if not hasattr(made, name)]

"""The figures of trials: those that a task has returned, checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

from armscan.checks import check_float
from armscan.errors import InvalidValueError, listed


def checked_figures(figures: Any, objectives: Sequence[str]) -> dict[str, float]:
    """Returns what a task has returned.

    Args:
        figures: by name; those that are no objectives may be NaN.
        objectives: the names of those that must be there, and finite.

    Raises:
        InvalidValueError: if it is anything else.
    """
    if not isinstance(figures, Mapping):
        raise InvalidValueError(f"the task has returned {figures!r}, but it must be figures by their names")
    if missing := [name for name in objectives if name not in figures]:
        raise InvalidValueError(f"the task has not returned {missing[0]}, but only {listed(list(figures))}")
    for name, figure in figures.items():
        if name in objectives:
            check_float(f"what the task has returned as {name}", figure)
        elif not isinstance(figure, Real):
            raise InvalidValueError(f"what the task has returned as {name} is {figure!r}, but it must be a number")
    return {str(name): float(figure) for name, figure in figures.items()}

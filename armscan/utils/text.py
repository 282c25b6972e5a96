"""Numbers of things in sentences."""

from __future__ import annotations


def counted(number: int, what: str) -> str:
    """Return a number with its noun, such as `1 seed` or `3 seeds`."""
    return f"{number} {what}{'' if number == 1 else 's'}"

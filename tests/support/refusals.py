"""Commands that refuse what they are given."""

from __future__ import annotations


def assert_refused(outcome: tuple[int, str, str], line: str) -> None:
    """Check that a command ended with exit code 2 and one line on standard error.

    Args:
        outcome: Its exit code, standard output and standard error.
        line: Beginning of the line, after `error: `.
    """
    code, _, errors = outcome
    assert code == 2, outcome
    assert errors.startswith(f"error: {line}"), (line, errors)
    assert len(errors.splitlines()) == 1, errors

"""Rates as strings."""

from __future__ import annotations

# Form of a rate where space is short.
PERCENT = "{:.0%}"


def formatted(form: str, value: float) -> str:
    """Return a value in a form such as `{:.1%}`; a rate is never rounded to 0 or 100 %, but `<0.1%` or `>99.9%`."""
    text = form.format(value)
    if form.endswith("%}") and 0.0 < value < 1.0:
        smallest = 10.0 ** -(len(text.partition(".")[2].rstrip("%")) + 2)
        for bound, sign, nearest in ((0.0, "<", smallest), (1.0, ">", 1.0 - smallest)):
            if text == form.format(bound):
                return sign + form.format(nearest)
    return text

"""Numbers and rates as text."""

import math

import pytest

from armscan.utils.text import formatted, markdown_table


@pytest.mark.parametrize(
    ("form", "value", "text"),
    [
        ("{:.1%}", 0.9996, ">99.9%"),
        ("{:.1%}", 0.0004, "<0.1%"),
        ("{:.0%}", 0.995, ">99%"),
        ("{:.0%}", 0.004, "<1%"),
        ("{:.1%}", 1.0, "100.0%"),
        ("{:.1%}", 0.0, "0.0%"),
        ("{:.1%}", 0.735, "73.5%"),
        ("{:.1%}", math.nan, "nan%"),
        ("{:.2f}", 0.0004, "0.00"),
        ("{:.1f} mm", -0.04, "0.0 mm"),
        ("{:.1f} mm", -0.06, "-0.1 mm"),
    ],
)
def test_rate_is_not_rounded_to_none_or_all_and_a_rounded_0_has_no_sign(form, value, text):
    assert formatted(form, value) == text


def test_no_cell_of_a_table_ends_early():
    assert (
        markdown_table(["a", "b"], [["wrist|1", "two\nlines"]])
        == "| a | b |\n| --- | ---: |\n| wrist\\|1 | two lines |"
    )

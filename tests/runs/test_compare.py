"""Two runs compared."""

import math

from hypothesis import given
from hypothesis import strategies as st

from armscan.runs.compare import Comparison, difference

POINTS = {"keys": st.integers(0, 9), "values": st.floats(), "max_size": 6}
SOME, ANY = st.dictionaries(**POINTS, min_size=1), st.dictionaries(**POINTS)


@given(SOME, ANY)
def test_difference_is_none_exactly_where_every_point_of_the_first_is_there_again(then, now):
    is_there_again = all(
        step in now and (now[step] == value or (math.isnan(now[step]) and math.isnan(value)))
        for step, value in then.items()
    )
    assert difference("m", then, now).is_same == is_there_again


@given(SOME)
def test_difference_from_a_run_that_went_on_for_longer_is_none(then):
    assert difference("m", then, then | {99: 1.0}).is_same


def test_difference_names_the_step_where_it_is_largest():
    found = difference("validation/mean_steps", {10: 4.0, 20: 2.0, 30: 1.0}, {10: 4.0, 20: 3.0, 40: 1.0})
    assert (found.largest, found.at_step, found.n_missing, found.n_new) == (1.0, 20, 1, 1)
    text = "validation/mean_steps: by 1 (50.00%) at step 20, where 2 became 3; 1 points are missing"
    assert str(found) == text


def test_difference_from_a_value_that_was_nan_is_infinite():
    found = difference("a", {1: math.nan, 2: 1.0}, {1: 1.0, 2: 1.0})
    assert (found.largest, found.relative, found.is_same) == (math.inf, math.inf, False)
    assert "by inf at step 1, where nan became 1" in str(found)


def test_comparison_says_what_differs_most_first_and_what_is_missing_before_all():
    parts = (
        difference("little", {1: 100.0}, {1: 101.0}),
        difference("much", {1: 1.0}, {1: 3.0}),
        difference("same", {1: 1.0}, {1: 1.0}),
        difference("gone", {1: 1.0}, {}),
    )
    comparison = Comparison(parts)
    lines = comparison.lines()
    assert lines[0] == "not the same: 3 of 4 metrics differ"
    assert [line.split(":")[0].strip() for line in lines[1:]] == ["gone", "much", "little"]
    assert comparison.to_dict()["metrics"][3]["largest"] is None
    assert Comparison(parts[2:3]).lines() == ["the same: 1 points of 1 metrics, to the last bit"]
    assert not Comparison(()).is_same
    assert parts[3].then is None

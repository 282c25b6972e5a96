"""Checks of arguments."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armscan.errors import InvalidValueError
from armscan.utils.validation import (
    check_bool,
    check_choice,
    check_float,
    check_int,
    check_ints,
    check_numbers,
    check_path,
    check_seed,
)

ANYTHING = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.lists(st.integers()), st.complex_numbers()
)


@given(st.integers(-100, 100), st.integers(-100, 100), st.integers(0, 100))
def test_whole_numbers_are_those_within_the_bounds(value, lowest, width):
    if lowest <= value <= lowest + width:
        assert check_int("n", value, at_least=lowest, at_most=lowest + width) == value
        assert type(check_int("n", np.int64(value), at_least=lowest)) is int
    else:
        with pytest.raises(
            InvalidValueError, match=rf"n is {value}, .* at least {lowest} and at most {lowest + width}"
        ):
            check_int("n", value, at_least=lowest, at_most=lowest + width)


@pytest.mark.parametrize("value", [True, 1.0, "1", None, math.nan, [1]])
def test_what_only_resembles_a_whole_number_is_refused(value):
    with pytest.raises(InvalidValueError, match="must be a whole number of at least 0"):
        check_int("n", value, at_least=0)


@given(ANYTHING)
def test_numbers_are_finite_or_refused(value):
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and abs(value) <= sys.float_info.max:
        assert check_float("x", value) == float(value)
    else:
        with pytest.raises(InvalidValueError, match=r"^x is .*, but it must be a finite number$"):
            check_float("x", value)


@pytest.mark.parametrize(
    ("bounds", "allowed", "refused", "words"),
    [
        ({"above": 0.0}, 1e-300, 0.0, "above 0"),
        ({"at_least": 0.0}, 0.0, -1e-300, "at least 0"),
        ({"at_most": 1.0}, 1.0, 1.0000001, "at most 1"),
        ({"above": 0.0, "at_most": 1.0}, 1.0, 0.0, "above 0 and at most 1"),
    ],
)
def test_bounds_of_a_number_are_kept_and_named(bounds, allowed, refused, words):
    assert check_float("x", allowed, **bounds) == allowed
    with pytest.raises(InvalidValueError, match=f"a finite number {words}$"):
        check_float("x", refused, **bounds)


@given(st.lists(st.floats(-1e300, 1e300), max_size=4), st.sampled_from([tuple, list, np.array]))
def test_numbers_of_the_wanted_length_come_as_a_tuple_of_floats(numbers, kind):
    assert check_numbers("x", kind(numbers), len(numbers), "in mm") == tuple(numbers)
    with pytest.raises(InvalidValueError, match=f"must be {len(numbers) + 1} finite numbers, in mm"):
        check_numbers("x", kind(numbers), len(numbers) + 1, "in mm")


@pytest.mark.parametrize("value", [(1.0, math.nan), (math.inf, 1.0), (True, 1.0), "12", 5, None, np.array(1.0)])
def test_two_numbers_that_are_none_are_refused(value):
    with pytest.raises(InvalidValueError, match="must be 2 finite numbers"):
        check_numbers("x", value, 2, "in mm")


@pytest.mark.parametrize("value", ["12", b"12", bytearray(b"12"), memoryview(b"12"), 12, (1, 2.0), (1, 2, 3)])
def test_what_is_no_list_of_two_whole_numbers_is_refused(value):
    with pytest.raises(InvalidValueError, match="size"):
        check_ints("size", value, 2, "(across, depth)", at_least=0)


def test_whole_numbers_in_a_list_of_any_length():
    assert check_ints("sizes", [3, 4, 5], None, "", at_least=3) == (3, 4, 5)
    with pytest.raises(InvalidValueError, match="each of sizes is 2"):
        check_ints("sizes", [3, 2], None, "", at_least=3)


@pytest.mark.parametrize("value", [-1, 2**31, 0.5])
def test_seed_that_some_generator_does_not_take_is_refused(value):
    assert check_seed("seed", 2**31 - 1) == 2**31 - 1
    with pytest.raises(InvalidValueError, match="seed is"):
        check_seed("seed", value)


def test_truth_values_choices_and_paths():
    assert check_bool("b", value=False) is False
    assert check_choice("c", "a", ("a", None)) == "a"
    assert check_path("p", "a/b") == Path("a/b")
    for value in (0, None, "true"):
        with pytest.raises(InvalidValueError, match="true or false"):
            check_bool("b", value)
    for value in ("b", np.array(["a"])):
        with pytest.raises(InvalidValueError, match=r"c is .*, but it must be"):
            check_choice("c", value, ("a", "z"))
    for value in (0, "", "a\0b", None):
        with pytest.raises(InvalidValueError, match="the path of a file or folder"):
            check_path("p", value)

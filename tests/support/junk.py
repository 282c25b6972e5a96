"""Values that nobody should pass."""

from fractions import Fraction

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from tests.volumes.test_damaged import anything, is_answered, result_of

__all__ = ["SETTINGS", "is_answered", "junk", "result_of"]

SETTINGS = settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)
ODD = [
    object(),
    object,
    int,
    np.ndarray,
    len,
    (n for n in range(2)),
    10**400,
    -(10**30),
    2**63,
    1e308,
    5e-324,
    1j,
    Fraction(10**400, 3),
    b"abc",
    "\0",
    "nan",
    {1, 2},
    range(2),
    ["y"],
    [["y"], ["x"]],
    [np.zeros(2)] * 2,
    (10**400, 10**400),
    (1e308, 1e308),
    [1, [2]],
    np.array(1.0),
    np.zeros(0),
    np.zeros((2, 2)),
    np.array([np.nan, 1.0]),
    np.array(["a", "b"]),
    np.array([None, 1], dtype=object),
    np.array([True, False]),
    np.array([1 + 1j, 0]),
    np.bool_(True),
    np.float32("inf"),
    np.int8(-3),
    np.datetime64("NaT"),
]
# Each odd value is likely to be tried, together with what hypothesis thinks of.
junk = st.sampled_from(ODD) | anything

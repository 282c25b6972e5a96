"""The waiting that trials do instead of training; it needs only Python, so that any platform can run it."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import NamedTuple

WAITED_FILE = "waited.json"
N_PARTS = 10


class Waited(NamedTuple):
    """Record of a trial.

    Args:
        length_s: Seconds that the trial was to wait.
        begin_s: Start time in seconds, on the clock that all processes share.
        end_s: End time in seconds.
    """

    length_s: float
    begin_s: float
    end_s: float


def wait(
    number: int, shortest_s: float, longest_s: float, on_part: Callable[[int], None] = lambda part: None
) -> Waited:
    """Wait as long as the trial with this number takes on every platform.

    Args:
        number: Number of the trial.
        shortest_s: Shortest wait in seconds.
        longest_s: Longest wait in seconds; waits are uniformly distributed between the two.
        on_part: Function called after each of the `N_PARTS` parts with its number, from 1; its time counts as waiting.
    """
    length_s = random.Random(number).uniform(shortest_s, longest_s)
    begin_s = time.time()
    for part in range(1, N_PARTS + 1):
        time.sleep(max(0.0, begin_s + length_s * part / N_PARTS - time.time()))
        on_part(part)
    return Waited(length_s, begin_s, time.time())

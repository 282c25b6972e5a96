"""Measure the processor time of environment steps, compared with an earlier checkout, in one run.

    python -m benchmarks.speed.steps --before CHECKOUT [--rounds N]

The default environment on the four default phantoms, and its vector form, with random actions, resets included, on one
thread. Each checkout has its own process; the two take turns of 2,000 steps of each case. Figures are medians of the
processor time over the rounds.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from functools import cache
from typing import Any

from benchmarks.repository import REPOSITORY
from benchmarks.speed.checkouts import ask, comparing_parser_of, serve, start
from benchmarks.tables import print_head, print_row

N_STEPS = 2000
CASES: dict[str, tuple[int, dict[str, Any]]] = {
    "one environment": (1, {}),
    "16 side by side": (16, {}),
    "64 side by side": (64, {}),
    "16 side by side, full": (16, {"projection": "full"}),
    "one environment, zy, the last 8 stacked, the best 4 remembered": (
        1,
        {"projection": "zy", "stack": 8, "memory": 4},
    ),
}


def main() -> None:
    """Print the table, or take steps for the process that prints it."""
    if sys.argv[1:] == ["--serve"]:
        serve(step_s)
        return
    parser = comparing_parser_of(__doc__, n_rounds=15)
    given = parser.parse_args()
    if given.before is None:
        parser.error("--before is not given: name the checkout to compare with")
    with start(__file__, REPOSITORY) as ours, start(__file__, given.before) as theirs:
        processes = ours, theirs
        for case in CASES:
            for process in processes:
                ask(process, case)
        print_head("", "us a step", "before", "ratio", "least", "most")
        rounds = [{case: [ask(each, case) for each in processes] for case in CASES} for _ in range(given.rounds)]
    for case in CASES:
        medians = (statistics.median(each) for each in zip(*(each[case] for each in rounds), strict=True))
        ratios = [before / now for now, before in (each[case] for each in rounds)]
        figures = (f"{each:.2f}" for each in (statistics.median(ratios), min(ratios), max(ratios)))
        print_row(case, *(f"{1e6 * each:.0f}" for each in medians), *figures)


def step_s(case: str) -> float:
    """Return the seconds of processor time of a step."""
    take_steps = steps_of(case)
    start_s = time.process_time()
    take_steps()
    return (time.process_time() - start_s) / N_STEPS


@cache
def steps_of(case: str) -> Callable[[], None]:
    """Return a function that takes the steps of a case, and has taken them once."""
    # From the checkout that this process was started for.
    import gymnasium as gym

    import armscan

    num_envs, rules = CASES[case]
    if num_envs > 1:
        envs: Any = gym.make_vec(armscan.ENV_ID, num_envs=num_envs, **rules)
    else:
        envs = gym.make(armscan.ENV_ID, disable_env_checker=True, **rules)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(N_STEPS // num_envs)]
    envs.reset(seed=0)

    def take_steps() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = envs.step(action)
            if num_envs == 1 and (terminated or truncated):
                envs.reset()

    take_steps()
    return take_steps


if __name__ == "__main__":
    main()

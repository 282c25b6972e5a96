"""Measure the processor time of environment steps, compared with an earlier checkout, in one run.

    python -m benchmarks.speed.steps --before CHECKOUT [--rounds N]

The default environment on the four default phantoms, and its vector form, with random actions, resets included, on one
thread. Each checkout has its own process; the two take turns of 2,000 steps of each case. Figures are medians of the
processor time over the rounds.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

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
        serve()
        return
    # Deferred: a process that serves another checkout has that checkout's benchmarks.
    from benchmarks.speed.checkouts import HERE, ask, end, parser_of, start

    parser = parser_of(__doc__)
    given = parser.parse_args()
    if given.before is None:
        parser.error("--before is not given: name the checkout to compare with")
    processes = [start(__file__, each) for each in (HERE, given.before)]
    for case in CASES:
        for process in processes:
            ask(process, case)
    print("| | us a step | before | ratio | least | most |\n| --- | --- | --- | --- | --- | --- |")
    rounds = [{case: [ask(each, case) for each in processes] for case in CASES} for _ in range(given.rounds)]
    for case in CASES:
        medians = [statistics.median(each[case][which] for each in rounds) for which in range(len(processes))]
        ratios = sorted(each[case][-1] / each[case][0] for each in rounds)
        print(
            f"| {case} | {' | '.join(f'{1e6 * each:.0f}' for each in medians)} | {statistics.median(ratios):.2f} "
            f"| {ratios[0]:.2f} | {ratios[-1]:.2f} |"
        )
    for process in processes:
        end(process)


def serve() -> None:
    """Answer each case that is asked for with the seconds of processor time of a step."""
    measures: dict[str, Callable[[], None]] = {}
    for line in sys.stdin:
        case = json.loads(line)
        if case not in measures:
            measures[case] = measured(*CASES[case])
            measures[case]()
        start_s = time.process_time()
        measures[case]()
        print((time.process_time() - start_s) / N_STEPS, flush=True)


def measured(num_envs: int, rules: dict[str, Any]) -> Callable[[], None]:
    """Return a function that takes the steps."""
    # From the checkout that this process was started for.
    import gymnasium as gym

    import armscan

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

    return take_steps


if __name__ == "__main__":
    main()

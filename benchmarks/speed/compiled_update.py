"""Measure the processor time of a compiled gradient step of SAC beside Tianshou's own, in turn in one run.

    python -m benchmarks.speed.compiled_update [--before CHECKOUT] [--rounds N]

Both learn from the same random steps on phantoms, batches of 256, each in a process of its own, on one thread.
Tianshou's step runs the code of CHECKOUT (default: this one). The figures to quote are the ratios, medians over the
rounds. A call takes as many compiled steps as `agent=sac` takes after a collection. They depend on the kernels that
OpenBLAS chooses for the processor: the script prints which, and a set `OPENBLAS_CORETYPE` overrides the choice.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from functools import cache
from importlib import import_module

from threadpoolctl import threadpool_info

from benchmarks.repository import REPOSITORY
from benchmarks.speed.checkouts import ask, comparing_parser_of, serve, start
from benchmarks.tables import print_head, print_row

N_RANDOM_STEPS, BATCH_SIZE, N_AT_ONCE, N_TIANSHOU, N_COMPILED = 1_000, 256, 4, 20, 100
# Projection, and units of the hidden layers.
CASES: dict[str, tuple[str, tuple[int, ...]]] = {
    "y, 64-64": ("y", (64, 64)),
    "full, 64-64": ("full", (64, 64)),
    "full, 256-256": ("full", (256, 256)),
}
COMPILED, TIANSHOU = "compiled", "Tianshou"


def main() -> None:
    """Print the table, or take gradient steps for the process that prints it."""
    if sys.argv[1:] == ["--serve"]:
        serve(step_ms)
        return
    given = comparing_parser_of(__doc__, n_rounds=15).parse_args()
    print(f"OpenBLAS kernels: {kernels()}\n")
    print_head("projection, network", "Tianshou, ms", "compiled, ms", "ratio, median", "least", "most")
    with start(__file__, given.before or REPOSITORY) as theirs, start(__file__, REPOSITORY) as ours:
        for case in CASES:
            # The first turn compiles.
            rounds = [
                (ask(theirs, f"{case}, {TIANSHOU}"), ask(ours, f"{case}, {COMPILED}")) for _ in range(1 + given.rounds)
            ][1:]
            ratios = [tianshou / compiled for tianshou, compiled in rounds]
            tianshou, compiled = (statistics.median(each) for each in zip(*rounds, strict=True))
            figures = (f"{each:.1f}" for each in (statistics.median(ratios), min(ratios), max(ratios)))
            print_row(case, f"{tianshou:.2f}", f"{compiled:.3f}", *figures)


def kernels() -> str:
    """Return the processor that OpenBLAS has chosen its kernels for."""
    import_module("scipy.linalg")
    return ", ".join(sorted({each["architecture"] for each in threadpool_info() if each["internal_api"] == "openblas"}))


def step_ms(case: str) -> float:
    """Return the milliseconds of processor time of a gradient step."""
    take_steps = steps_of(case)
    start_s = time.process_time()
    n_updates = take_steps()
    return (time.process_time() - start_s) / n_updates * 1000.0


@cache
def steps_of(case: str) -> Callable[[], int]:
    """Return a function that takes gradient steps, and returns their number."""
    # From the checkout that this process was started for.
    import torch
    from tianshou.algorithm.modelfree import sac
    from tianshou.utils.torch_utils import policy_within_training_step

    from armscan.agents import MLP, SAC
    from armscan.envs import EnvFactory
    from armscan.volumes import load_phantoms
    from benchmarks.speed.agent_setup import agent_setup

    torch.set_num_threads(1)
    name, _, way = case.rpartition(", ")
    projection, hidden_sizes = CASES[name]
    setup = agent_setup(EnvFactory(projection=projection), load_phantoms(range(2)), 10 * N_RANDOM_STEPS)
    learner = SAC(network=MLP(hidden_sizes), learning_starts=N_RANDOM_STEPS).agent(setup)
    learner.warm_up()
    algorithm, replay = learner._algorithm, learner._replay

    def take_steps() -> int:
        with policy_within_training_step(algorithm.policy):
            if way == COMPILED:
                for _ in range(N_COMPILED // N_AT_ONCE):
                    algorithm.update_repeatedly(replay, BATCH_SIZE, N_AT_ONCE)
                return N_COMPILED
            for _ in range(N_TIANSHOU):
                sac.SAC.update(algorithm, replay, BATCH_SIZE)
            return N_TIANSHOU

    return take_steps


if __name__ == "__main__":
    main()

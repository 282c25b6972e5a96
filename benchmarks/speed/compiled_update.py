"""Measure the processor time of a compiled gradient step of SAC beside Tianshou's own, in turn in one run.

    python -m benchmarks.speed.compiled_update [--before CHECKOUT] [--rounds N]

Both learn from the same random steps on phantoms, batches of 256, each in a process of its own, on one thread.
Tianshou's step runs the code of CHECKOUT (default: this one). The figures to quote are the ratios, medians over the
rounds. A call takes as many compiled steps as `agent=sac` takes after a collection.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial

N_RANDOM_STEPS, BATCH_SIZE, N_AT_ONCE, N_TIANSHOU, N_COMPILED = 1_000, 256, 4, 20, 100
ACTIONS = {"y": ("ty",), "full": ("rz", "rx", "tx", "ty")}
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
        serve()
        return
    # Deferred: a process that serves another checkout has that checkout's benchmarks.
    from benchmarks.speed.checkouts import HERE, ask, end, parser_of, start

    given = parser_of(__doc__).parse_args()
    theirs, ours = (start(__file__, each) for each in (given.before or HERE, HERE))
    print("| projection, network | Tianshou, ms | compiled, ms | ratio, median | least | most |")
    print("| --- | --- | --- | --- | --- | --- |")
    for case in CASES:
        # The first turn compiles.
        rounds = [
            (ask(theirs, f"{case}, {TIANSHOU}"), ask(ours, f"{case}, {COMPILED}")) for _ in range(1 + given.rounds)
        ][1:]
        ratios = [tianshou / compiled for tianshou, compiled in rounds]
        tianshou, compiled = (statistics.median(each) for each in zip(*rounds, strict=True))
        print(
            f"| {case} | {tianshou:.2f} | {compiled:.3f} | {statistics.median(ratios):.1f} | {min(ratios):.1f} "
            f"| {max(ratios):.1f} |",
            flush=True,
        )
    for process in (theirs, ours):
        end(process)


def serve() -> None:
    """Answer each case that is asked for with the milliseconds of processor time of a gradient step."""
    measures: dict[str, Callable[[], int]] = {}
    # What is logged must not look like an answer.
    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        case = json.loads(line)
        if case not in measures:
            measures[case] = measured(*CASES[case.rpartition(", ")[0]], is_compiled=case.endswith(COMPILED))
        start_s = time.process_time()
        n_updates = measures[case]()
        print((time.process_time() - start_s) / n_updates * 1000.0, file=answers, flush=True)


def measured(projection: str, hidden_sizes: tuple[int, ...], *, is_compiled: bool) -> Callable[[], int]:
    """Return a function that takes gradient steps, and returns their number."""
    # From the checkout that this process was started for.
    import torch
    from tianshou.algorithm.modelfree import sac
    from tianshou.utils.torch_utils import policy_within_training_step

    from armscan.agents import MLP, SAC, AgentSetup, Compute
    from armscan.envs import EnvFactory
    from armscan.volumes import load_phantoms

    torch.set_num_threads(1)
    env_factory, volumes = EnvFactory(projection=projection), load_phantoms(range(2))
    setup = AgentSetup(
        make_envs=partial(env_factory.make_vector_env, volumes=volumes, autoreset_mode="Disabled"),
        observation_space=env_factory.make_env(volumes).observation_space,
        action_names=ACTIONS[projection],
        total_env_steps=10 * N_RANDOM_STEPS,
        seed=0,
        compute=Compute("cpu"),
    )
    learner = SAC(network=MLP(hidden_sizes), learning_starts=N_RANDOM_STEPS).agent(setup)
    learner.warm_up()
    algorithm, replay = learner._algorithm, learner._replay

    def take_steps() -> int:
        with policy_within_training_step(algorithm.policy):
            if is_compiled:
                for _ in range(N_COMPILED // N_AT_ONCE):
                    algorithm.update_repeatedly(replay, BATCH_SIZE, N_AT_ONCE)
                return N_COMPILED
            for _ in range(N_TIANSHOU):
                sac.SAC.update(algorithm, replay, BATCH_SIZE)
            return N_TIANSHOU

    return take_steps


if __name__ == "__main__":
    main()

"""Measure the processor time of a compiled gradient step of SAC beside Tianshou's own.

    python -m benchmarks.speed.compiled_update [ROUNDS]

Both learn from one replay buffer of random steps on phantoms, batches of 256, in turn in one process on one thread;
the figures to quote are the ratios, medians over the rounds (default: 15). As many steps are taken at once as after a
collection with the values of `agent=sac`.
"""

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"

import statistics
import sys
import time
from functools import partial

import torch
from tianshou.utils.torch_utils import policy_within_training_step

from armscan.agents import MLP, SAC, AgentSetup, Compute
from armscan.agents.tianshou_learner import TianshouLearner
from armscan.envs import EnvFactory
from armscan.utils.log import silence_libraries
from armscan.volumes import load_phantoms

N_RANDOM_STEPS, BATCH_SIZE, N_AT_ONCE, N_TIANSHOU, N_COMPILED = 1_000, 256, 4, 20, 100
ACTIONS = {"y": ("ty",), "full": ("rz", "rx", "tx", "ty")}
CASES = (("y", (64, 64)), ("full", (64, 64)), ("full", (256, 256)))


def learner(projection: str, hidden_sizes: tuple[int, ...]) -> TianshouLearner:
    """Return a learner whose replay buffer is filled."""
    env_factory, volumes = EnvFactory(projection=projection), load_phantoms(range(2))
    setup = AgentSetup(
        make_envs=partial(env_factory.make_vector_env, volumes=volumes, autoreset_mode="Disabled"),
        observation_space=env_factory.make_env(volumes).observation_space,
        action_names=ACTIONS[projection],
        total_env_steps=10 * N_RANDOM_STEPS,
        seed=0,
        compute=Compute("cpu"),
    )
    made = SAC(network=MLP(hidden_sizes), learning_starts=N_RANDOM_STEPS).agent(setup)
    made.warm_up()
    return made


def milliseconds(made: TianshouLearner, n_updates: int, *, is_compiled: bool) -> float:
    """Return the processor time of an update."""
    algorithm, replay = made._algorithm, made._replay
    start_s = time.process_time()
    with policy_within_training_step(algorithm.policy):
        if is_compiled:
            for _ in range(n_updates // N_AT_ONCE):
                algorithm.update_repeatedly(replay, BATCH_SIZE, N_AT_ONCE)
        else:
            for _ in range(n_updates):
                super(type(algorithm), algorithm).update(replay, BATCH_SIZE)
    return (time.process_time() - start_s) / n_updates * 1000.0


def main(words: list[str]) -> None:
    """Measure every case and print its table."""
    silence_libraries()
    torch.set_num_threads(1)
    n_rounds = int(words[0]) if words else 15
    print("| projection, network | Tianshou, ms | compiled, ms | ratio, median | least | most |")
    print("| --- | --- | --- | --- | --- | --- |")
    for projection, hidden_sizes in CASES:
        made = learner(projection, hidden_sizes)
        for is_compiled in (True, False):
            milliseconds(made, N_AT_ONCE, is_compiled=is_compiled)
        rounds = [
            (milliseconds(made, N_TIANSHOU, is_compiled=False), milliseconds(made, N_COMPILED, is_compiled=True))
            for _ in range(n_rounds)
        ]
        ratios = [theirs / ours for theirs, ours in rounds]
        theirs, ours = (statistics.median(each) for each in zip(*rounds, strict=True))
        network = "-".join(map(str, hidden_sizes))
        print(
            f"| {projection}, {network} | {theirs:.2f} | {ours:.3f} | {statistics.median(ratios):.1f} | "
            f"{min(ratios):.1f} | {max(ratios):.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main(sys.argv[1:])

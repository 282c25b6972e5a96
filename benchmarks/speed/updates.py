"""Measure the gradient steps per second of SAC, by device, precision and compilation.

    python -m benchmarks.speed.updates [PART ...]

SAC on phantoms, with batches of 256: a replay buffer of random steps, then rounds of Tianshou's own update, in each way
in turn (`compiled_update.py` measures the one that Numba compiles). The figures to quote are the ratios to float32
without torch.compile on the CPU, each the median over the rounds. Uses the available devices; on a GPU, time ends when
all queued work is done.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import statistics
import time
from functools import partial

import torch
from tianshou.algorithm.modelfree import sac
from tianshou.utils.torch_utils import policy_within_training_step

from armscan.agents import MLP, SAC, Compute, Multimodal, Network
from armscan.envs import EnvFactory, SliceChannelsObservation
from armscan.utils.log import silence_libraries
from armscan.volumes import load_phantoms
from benchmarks.arguments import parser_of
from benchmarks.speed.agent_setup import agent_setup
from benchmarks.tables import print_head, print_row

N_ROUNDS, N_RANDOM_STEPS, ROUND_S = 5, 1_000, 3.0
CASES: dict[str, tuple[EnvFactory, Network]] = {
    "cluster, 64-64": (EnvFactory(projection="full"), MLP((64, 64))),
    "slice_channels 48 x 36": (
        EnvFactory(projection="full", observation=SliceChannelsObservation(shape=(48, 36))),
        Multimodal(),
    ),
    "slice_channels 84 x 84, stack 4": (
        EnvFactory(projection="full", observation=SliceChannelsObservation(shape=(84, 84)), stack=4),
        Multimodal(),
    ),
}


def ways() -> dict[str, Compute]:
    """Return the ways of computing that this machine has, by name."""
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    return {
        f"{device}, {precision}{', torch.compile' if is_compiled else ''}": Compute(device, precision, is_compiled)
        for device in devices
        for precision in ("float32", "bfloat16")
        for is_compiled in (False, True)
    }


def updater(env_factory: EnvFactory, network: Network, compute: Compute, *, by_tianshou: bool):
    """Return a function that measures updates per second, Tianshou's or the agent's, with a filled replay buffer."""
    setup = agent_setup(env_factory, load_phantoms(range(2)), 10 * N_RANDOM_STEPS, compute)
    learner = SAC(network=network, learning_starts=N_RANDOM_STEPS).agent(setup)
    learner.warm_up()
    algorithm, replay = learner._algorithm, learner._replay
    update = partial(sac.SAC.update, algorithm) if by_tianshou else algorithm.update

    def measure(seconds: float = ROUND_S) -> float:
        n_updates, start_s = 0, time.perf_counter()
        with policy_within_training_step(algorithm.policy):
            while n_updates < 3 or time.perf_counter() - start_s < seconds:
                update(buffer=replay, sample_size=256)
                n_updates += 1
        if compute.torch_device == "cuda":
            torch.cuda.synchronize()
        return n_updates / (time.perf_counter() - start_s)

    return measure


def main() -> None:
    """Measure every case and print its table."""
    parser = parser_of(__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help="part of a case's name (default: all cases)")
    parts = parser.parse_args().parts
    silence_libraries()
    torch.set_num_threads(1)
    chosen = {name: case for name, case in CASES.items() if not parts or any(part in name for part in parts)}
    if not chosen:
        parser.error(f"{' '.join(parts)} is part of no name: {', '.join(CASES)}")
    print_head("observation, network", "computed", "updates/s, median", "best", "beside the first")
    for name, (env_factory, network) in chosen.items():
        measures = {way: updater(env_factory, network, compute, by_tianshou=True) for way, compute in ways().items()}
        for measure in measures.values():
            # Compiles.
            measure(0.0)
        rounds = [{way: measure() for way, measure in measures.items()} for _ in range(N_ROUNDS)]
        first = next(iter(measures))
        for way in measures:
            figures = [each[way] for each in rounds]
            ratio = statistics.median(each[way] / each[first] for each in rounds)
            print_row(name, way, f"{statistics.median(figures):.1f}", f"{max(figures):.1f}", f"{ratio:.2f}")


if __name__ == "__main__":
    main()

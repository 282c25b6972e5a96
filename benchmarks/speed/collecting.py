"""Measure the processor time of collecting steps, compared with Tianshou's own collector.

    python -m benchmarks.speed.collecting [--rounds 15]

Both collect one step of each of 16 environments at a time, with the same policy, in turn in one process on one thread.
The time of the environments is measured separately; the rest is the collector's: choosing actions, storing transitions,
statistics. The figures to quote are the ratios, medians over the rounds (default: 15).
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import statistics
import time
from typing import Any

import torch
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.utils.torch_utils import policy_within_training_step

from armscan.agents import MLP, PPO, SAC
from armscan.agents.step_collector import StepCollector
from armscan.agents.tianshou_envs import TianshouVectorEnv
from armscan.envs import EnvFactory
from armscan.utils.log import silence_libraries
from armscan.volumes import load_phantoms
from benchmarks.arguments import count, parser_of
from benchmarks.speed.agent_setup import agent_setup
from benchmarks.tables import print_head, print_row

N_COLLECTIONS, N_STEPS, TOTAL_STEPS = 50, 16, 100_000
CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "SAC, y": (SAC, {"projection": "y"}),
    "SAC, full": (SAC, {"projection": "full"}),
    "SAC, zy, the last 8 stacked, the best 4 remembered": (SAC, {"projection": "zy", "stack": 8, "memory": 4}),
    "PPO, y": (PPO, {"projection": "y"}),
}


class TimedEnvs(TianshouVectorEnv):
    """Environments that count their processor time."""

    seconds = 0.0

    def begin(self, mask: Any) -> Any:
        """See `TianshouVectorEnv.begin`."""
        return self._timed(super().begin, mask)

    def advance(self, actions: Any) -> Any:
        """See `TianshouVectorEnv.advance`."""
        return self._timed(super().advance, actions)

    def _timed(self, method: Any, argument: Any) -> Any:
        start_s = time.process_time()
        result = method(argument)
        self.seconds += time.process_time() - start_s
        return result


def collectors(kind: Any, rules: dict[str, Any]) -> list[Collector[Any]]:
    """Return Tianshou's collector and ours, each with environments of its own."""
    setup = agent_setup(EnvFactory(**rules), load_phantoms(range(4)), TOTAL_STEPS)
    ours: Any = kind(network=MLP((64, 64))).agent(setup)._collector
    theirs_envs, our_envs = (TimedEnvs(setup.make_envs(ours.env_num)) for _ in range(2))
    theirs = Collector(ours.policy, theirs_envs, VectorReplayBuffer(TOTAL_STEPS, ours.env_num), exploration_noise=True)
    replay = type(ours.buffer)(TOTAL_STEPS, ours.env_num)
    both = [theirs, StepCollector(ours.policy, our_envs, replay, setup.compute)]
    for each in both:
        each.env.seed(list(range(ours.env_num)))
        each.reset_env()
    return both


def milliseconds(collector: Any) -> tuple[float, float]:
    """Return the processor milliseconds of a collection, and of the environments in it."""
    collector.env.seconds, start_s = 0.0, time.process_time()
    with policy_within_training_step(collector.policy):
        for _ in range(N_COLLECTIONS):
            collector.collect(n_step=N_STEPS)
    seconds = time.process_time() - start_s
    return seconds / N_COLLECTIONS * 1000.0, collector.env.seconds / N_COLLECTIONS * 1000.0


def main() -> None:
    """Measure every case and print its table."""
    parser = parser_of(__doc__)
    parser.add_argument("--rounds", type=count, default=15, help="default: %(default)s")
    n_rounds = parser.parse_args().rounds
    silence_libraries()
    torch.set_num_threads(1)
    beside = "Tianshou, ms", "ours, ms", "ratio", "without them: Tianshou", "ours", "ratio"
    print_head("16 steps", "environments, ms", *beside)
    for name, (kind, rules) in CASES.items():
        theirs, ours = collectors(kind, rules)
        for each in (theirs, ours):
            milliseconds(each)
        rounds = [(*milliseconds(theirs), *milliseconds(ours)) for _ in range(n_rounds)]
        whole = statistics.median(theirs / ours for theirs, _, ours, _ in rounds)
        own = [(theirs - their_envs, ours - our_envs) for theirs, their_envs, ours, our_envs in rounds]
        ratio = statistics.median(theirs / ours for theirs, ours in own)
        theirs_ms, _, ours_ms, envs_ms = (statistics.median(each) for each in zip(*rounds, strict=True))
        their_own, our_own = (statistics.median(each) for each in zip(*own, strict=True))
        figures = (f"{each:.2f}" for each in (envs_ms, theirs_ms, ours_ms, whole, their_own, our_own))
        print_row(name, *figures, f"{ratio:.1f}")


if __name__ == "__main__":
    main()

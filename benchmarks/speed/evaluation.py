"""Measure the evaluation of episodes side by side against the same episodes one by one, in one run.

    python -m benchmarks.speed.evaluation [--before CHECKOUT] [PART-OF-A-NAME ...]

Each agent plays a validation (48 episodes) or a final evaluation (200) on phantoms, one by one and side by side, in
turn; the episodes must be bit-identical. The column `through Tianshou` is how policies were called before: with one
observation at a time, by Tianshou. Times are processor time on one core; the figures to quote are the ratios to `side
by side`, each the median over the rounds. With `--before`, another process plays as many episodes with the code of that
checkout, and an agent that it has trained itself.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import argparse
import statistics
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tianshou.data import Batch

# Only what an earlier checkout has, too; the rest is imported where it is used.
from armscan.agents import MLP, PPO, SAC, Agent, Exhaustive, Learner, OptunaSearch, Random
from armscan.envs import EnvFactory
from armscan.training import Evaluation, evaluate
from armscan.volumes import load_phantoms
from benchmarks.speed.agent_setup import agent_setup
from benchmarks.speed.checkouts import ask, comparing_parser_of, serve, start
from benchmarks.tables import print_head, print_row

if TYPE_CHECKING:
    from armscan.agents.tianshou_learner import TianshouLearner
    from armscan.envs.actions import ActionBounds

N_ROUNDS, SEED = 3, 10**6
VOLUMES = range(8)
Y, FULL = EnvFactory(rotation_bounds_deg=(90.0, 45.0)), EnvFactory(projection="full", rotation_bounds_deg=(90.0, 45.0))
# The environment, the algorithm, environment steps to learn before, and episodes.
CASES = {
    "SAC 64-64, y, untrained, 48 episodes": (Y, SAC(network=MLP((64, 64))), 0, 48),
    "SAC 64-64, y, trained for 6,000 steps, 48 episodes": (Y, SAC(network=MLP((64, 64))), 6_000, 48),
    "SAC 64-64, y, trained for 6,000 steps, 200 episodes": (Y, SAC(network=MLP((64, 64))), 6_000, 200),
    "SAC 256-256, full, untrained, 48 episodes": (FULL, SAC(network=MLP((256, 256))), 0, 48),
    "PPO 64-64, y, untrained, 48 episodes": (Y, PPO(network=MLP((64, 64))), 0, 48),
    "random, y, 200 episodes": (Y, Random(), 0, 200),
    "exhaustive, y, 200 episodes": (Y, Exhaustive(), 0, 200),
    "Optuna's TPE, y, 48 episodes": (Y, OptunaSearch(), 0, 48),
}


@cache
def player(case: str) -> tuple[Agent, Any]:
    """Return the agent of a case, which has learned for its environment steps, and its environment."""
    env_factory, algorithm, n_env_steps, _ = CASES[case]
    volumes = load_phantoms(VOLUMES)
    agent, env = algorithm.agent(agent_setup(env_factory, volumes, 20_000)), env_factory.make_env(volumes)
    if n_env_steps:
        assert isinstance(agent, Learner)
        agent.warm_up()
        agent.learn(n_env_steps)
    # Compiles.
    evaluate(agent, env, n_episodes=2, seed=0)
    return agent, env


class ThroughTianshou:
    """Calls a learner's policy as Tianshou does, with one observation at a time."""

    def __init__(self, learner: TianshouLearner) -> None:
        self._policy = learner._algorithm.policy

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin an episode."""

    def act(self, observation, reward: float):
        """Return the policy's action."""
        from armscan.agents.policy import batch_of

        with torch.no_grad():
            result = self._policy(Batch(obs=batch_of([observation]), info=Batch()))
        return np.asarray(self._policy.map_action(result.act.numpy())[0])


def one_by_one(agent: Agent, env, n_episodes: int) -> Evaluation:
    """Play the episodes of `evaluate` one after another."""
    from armscan.training.episodes import play

    names = list(env.get_wrapper_attr("volumes"))
    return Evaluation(tuple(play(agent, env, names[i % len(names)], SEED + i) for i in range(n_episodes)))


def measured(task) -> tuple[float, Evaluation]:
    """Return the seconds of processor time that a task takes, and what it returns."""
    start_s = time.process_time()
    evaluation = task()
    return time.process_time() - start_s, evaluation


def played(case: str) -> tuple[float, float]:
    """Return the seconds and the mean steps of the evaluation of a case."""
    seconds, evaluation = measured(partial(evaluate, *player(case), n_episodes=CASES[case][-1], seed=SEED))
    return seconds, evaluation.mean_steps


def measure(case: str, before: Callable[[str], list[float]] | None) -> list[str]:
    """Return the row of a case.

    Args:
        case: Name of the case.
        before: Returns the seconds and the mean steps of the code before; None without another checkout.
    """
    from armscan.agents.tianshou_learner import TianshouLearner

    (agent, env), n_episodes = player(case), CASES[case][-1]
    rounds, n_steps = [], float("nan")
    slow = ThroughTianshou(agent) if isinstance(agent, TianshouLearner) else agent
    for _ in range(N_ROUNDS):
        slow_s, _ = measured(partial(one_by_one, slow, env, n_episodes))
        alone_s, alone = measured(partial(one_by_one, agent, env, n_episodes))
        together_s, together = measured(partial(evaluate, agent, env, n_episodes=n_episodes, seed=SEED))
        assert together == alone, "the episodes differ"
        before_s = []
        if before:
            seconds, n_steps = before(case)
            before_s.append(seconds)
        rounds.append((together_s, alone_s, slow_s, *before_s))
    together_s, alone_s, *others_s = (statistics.median(each) for each in zip(*rounds, strict=True))
    cells = [case, f"{together.mean_steps:.1f}", f"{together_s:.2f}", f"{alone_s:.2f}"]
    for place, other_s in enumerate(others_s, start=2):
        cells += [f"{other_s:.2f}", f"{statistics.median(each[place] / each[0] for each in rounds):.1f}"]
    return [*cells, f"{n_steps:.1f}"] if before else cells


def main() -> None:
    """Print the table, or play episodes for the process that prints it."""
    parser = comparing_parser_of(__doc__)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("parts", nargs="*", help="Parts of the names of cases. Default: all cases.")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.serve:
        serve(played)
        return
    from armscan.utils.log import silence_libraries

    silence_libraries()
    cases = [case for case in CASES if not given.parts or any(part in case for part in given.parts)]
    if not cases:
        parser.error(f"{' '.join(given.parts)} is part of no name: {', '.join(CASES)}")
    columns = ["agent", "mean steps", "side by side, s", "one by one, s", "through Tianshou, s", "ratio"]
    print_head(*columns, *(("before, s", "ratio", "its mean steps") if given.before else ()))
    with start(__file__, given.before) if given.before else nullcontext() as process:
        for case in cases:
            print_row(*measure(case, partial(ask, process) if process else None))


if __name__ == "__main__":
    main()

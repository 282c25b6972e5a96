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

for _variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from tianshou.data import Batch

# Only what an earlier checkout has, too; the rest is imported where it is used.
from armscan.agents import MLP, PPO, SAC, Agent, AgentSetup, Compute, Exhaustive, Learner, OptunaSearch, Random
from armscan.envs import EnvFactory
from armscan.training import Evaluation, evaluate
from armscan.volumes import load_phantoms

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


def made(env_factory: EnvFactory, algorithm, n_env_steps: int) -> Agent:
    """Return an agent that has learned for this many environment steps."""
    volumes = load_phantoms(VOLUMES)
    env = env_factory.make_env(volumes)
    setup = AgentSetup(
        make_envs=partial(env_factory.make_vector_env, volumes=volumes, autoreset_mode="Disabled"),
        observation_space=env.observation_space,
        action_names=env.get_wrapper_attr("action_names"),
        total_env_steps=20_000,
        seed=0,
        compute=Compute("cpu"),
    )
    agent = algorithm.agent(setup)
    if n_env_steps:
        assert isinstance(agent, Learner)
        agent.warm_up()
        agent.learn(n_env_steps)
    return agent


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


def serve() -> None:
    """Answer each case that is asked for with the seconds and the mean steps of its evaluation."""
    torch.set_num_threads(1)
    players = {}
    for line in sys.stdin:
        env_factory, algorithm, n_env_steps, n_episodes = CASES[case := json.loads(line)]
        if case not in players:
            players[case] = made(env_factory, algorithm, n_env_steps), env_factory.make_env(load_phantoms(VOLUMES))
            # Compiles.
            evaluate(*players[case], n_episodes=2, seed=0)
        seconds, evaluation = measured(partial(evaluate, *players[case], n_episodes=n_episodes, seed=SEED))
        print(json.dumps([seconds, evaluation.mean_steps]), flush=True)


def measure(case: str, before: Callable[[str], list[float]] | None) -> str:
    """Return the row of a case.

    Args:
        case: Name of the case.
        before: Returns the seconds and the mean steps of the code before; None without another checkout.
    """
    from armscan.agents.tianshou_learner import TianshouLearner

    env_factory, algorithm, n_env_steps, n_episodes = CASES[case]
    agent, env = made(env_factory, algorithm, n_env_steps), env_factory.make_env(load_phantoms(VOLUMES))
    # Compiles.
    evaluate(agent, env, n_episodes=2, seed=0)
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
    cells = [f"{together.mean_steps:.1f}", f"{together_s:.2f}", f"{alone_s:.2f}"]
    for place, other_s in enumerate(others_s, start=2):
        cells += [f"{other_s:.2f}", f"{statistics.median(each[place] / each[0] for each in rounds):.1f}"]
    return " | ".join(("", case, *cells, *([f"{n_steps:.1f}"] if before else []), "")).strip()


def main() -> None:
    """Print the table, or play episodes for the process that prints it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--before", type=Path, metavar="CHECKOUT", help="Another checkout to measure beside this one.")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("parts", nargs="*", help="Parts of the names of cases. Default: all cases.")
    given = parser.parse_args()
    if given.serve:
        serve()
        return
    from armscan.utils.log import silence_libraries
    from benchmarks.speed.checkouts import ask, end, start

    silence_libraries()
    torch.set_num_threads(1)
    columns = ["agent", "mean steps", "side by side, s", "one by one, s", "through Tianshou, s", "ratio"]
    process = start(__file__, given.before) if given.before else None
    columns += ["before, s", "ratio", "its mean steps"] if process else []
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}")
    for case in CASES:
        if not given.parts or any(part in case for part in given.parts):
            print(measure(case, partial(ask, process) if process else None), flush=True)
    if process:
        end(process)


if __name__ == "__main__":
    main()

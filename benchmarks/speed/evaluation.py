"""Measure evaluation of episodes side by side against the same episodes one by one, in one run.

    python -m benchmarks.speed.evaluation [PART-OF-A-NAME ...]

Each agent plays a validation (48 episodes) or a final evaluation (200) on phantoms, one by one and side by side, in
turn; the episodes must be the same to the bit. The first column is how policies were asked before: one by one, through
Tianshou. Measured is the processor time of one core; the figures to quote are the ratios, each the median over the
rounds.
"""

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"

import statistics
import sys
import time
from functools import partial

import numpy as np
import torch
from tianshou.data import Batch

from armscan.agents import MLP, PPO, SAC, Agent, AgentSetup, Compute, Exhaustive, Learner, OptunaSearch, Random
from armscan.agents.policy import batch_of
from armscan.agents.tianshou_learner import TianshouLearner
from armscan.envs import EnvFactory
from armscan.envs.actions import ActionBounds
from armscan.training import Evaluation, evaluate
from armscan.training.episodes import play
from armscan.utils.log import silence_libraries
from armscan.volumes import load_phantoms

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
    """Return an agent that has learned for as many environment steps."""
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
    """Asks a learner's policy as Tianshou does, one observation after another."""

    def __init__(self, learner: TianshouLearner) -> None:
        self._policy = learner._algorithm.policy

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin an episode."""

    def act(self, observation, reward: float):
        """Return the policy's action."""
        with torch.no_grad():
            result = self._policy(Batch(obs=batch_of([observation]), info=Batch()))
        return np.asarray(self._policy.map_action(result.act.numpy())[0])


def one_by_one(agent: Agent, env, n_episodes: int) -> Evaluation:
    """Play the episodes of `evaluate` one after another."""
    names = list(env.get_wrapper_attr("volumes"))
    return Evaluation(tuple(play(agent, env, names[i % len(names)], SEED + i) for i in range(n_episodes)))


def measured(task) -> tuple[float, Evaluation]:
    """Return the seconds of processor time that a task takes, and what it returns."""
    start_s = time.process_time()
    evaluation = task()
    return time.process_time() - start_s, evaluation


def main(words: list[str]) -> None:
    """Measure every case and print its row."""
    silence_libraries()
    torch.set_num_threads(1)
    print("| agent | mean steps | through Tianshou, s | one by one, s | side by side, s | times as fast as the first |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, (env_factory, algorithm, n_env_steps, n_episodes) in CASES.items():
        if words and not any(word in name for word in words):
            continue
        agent, env = made(env_factory, algorithm, n_env_steps), env_factory.make_env(load_phantoms(VOLUMES))
        # Compiles.
        evaluate(agent, env, n_episodes=2, seed=0)
        rounds = []
        before = ThroughTianshou(agent) if isinstance(agent, TianshouLearner) else agent
        for _ in range(N_ROUNDS):
            before_s, _ = measured(partial(one_by_one, before, env, n_episodes))
            alone_s, alone = measured(partial(one_by_one, agent, env, n_episodes))
            together_s, together = measured(partial(evaluate, agent, env, n_episodes=n_episodes, seed=SEED))
            assert together == alone, "the episodes differ"
            rounds.append((before_s, alone_s, together_s))
        ratio = statistics.median(before_s / together_s for before_s, _, together_s in rounds)
        seconds = " | ".join(f"{statistics.median(each):.2f}" for each in zip(*rounds, strict=True))
        print(f"| {name} | {together.mean_steps:.1f} | {seconds} | {ratio:.1f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

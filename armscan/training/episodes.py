"""Whole episodes, played without exploration: one by one, or many side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from armscan.agents.batch_agent import BatchAgent, batch_agent
from armscan.agents.protocols import Agent
from armscan.anatomy import nerve_area_error, tissue_dice
from armscan.envs import ArmscanVectorEnv
from armscan.envs.episode import Episode
from armscan.envs.factory import vectorise
from armscan.envs.history import rows_of
from armscan.envs.vector_env import reset_each, step_each
from armscan.stats.on_plane import ON_PLANE, OnPlane
from armscan.training.episode_results import Env, EpisodeResult, Evaluation
from armscan.utils.validation import check_int

# Maximum number of episodes side by side; more would hardly be faster, and each keeps its observations in memory.
MAX_SIDE_BY_SIDE = 64


def evaluate(
    agent: Agent, env: Env, *, n_episodes: int, seed: int, on_plane: tuple[OnPlane, ...] = ON_PLANE
) -> Evaluation:
    """Play episodes on each of the environment's volumes in turn, many of them side by side.

    Each equals, bit for bit, the episode that `play` plays.

    Args:
        agent: Agent to evaluate. Each episode is played by a copy of it, unless it is a `BatchAgent`.
        env: An `ArmscanEnv`, with or without its wrappers, whose rules the episodes follow; it does not change.
        n_episodes: Number of episodes; a multiple of the number of volumes treats them alike.
        seed: Seed of the first episode; the next has the next seed. The same seed gives the same episodes to every
            agent.
        on_plane: Limits within which a plane counts as the labelled one. Default: those of `Evaluation`.
    """
    names = list(env.get_wrapper_attr("volumes"))
    count = check_int("episodes", n_episodes, at_least=1)
    planned = [(names[i % len(names)], seed + i) for i in range(count)]
    envs, player = vectorise(env, min(count, MAX_SIDE_BY_SIDE)), batch_agent(agent)
    batches = (planned[i : i + envs.num_envs] for i in range(0, count, envs.num_envs))
    return Evaluation(tuple(chain.from_iterable(_play_all(player, envs, batch) for batch in batches)), on_plane)


def _play_all(
    agent: BatchAgent, envs: VectorEnv[Any, Any, Any], planned: Sequence[tuple[str, int]]
) -> list[EpisodeResult]:
    """Play episodes on the named volumes with the seeds beside them, at most one in each environment."""
    bare = envs.unwrapped
    assert isinstance(bare, ArmscanVectorEnv)
    # Only what the wrappers require; the rest comes from the episodes.
    bare.info_keys = ("action", "reward")
    names, seeds = [name for name, _ in planned], [seed for _, seed in planned]
    n_idle = envs.num_envs - len(planned)
    is_played = np.arange(envs.num_envs) < len(planned)
    observations, _ = reset_each(
        envs, [*seeds, *[None] * n_idle], {"volume": names + names[:1] * n_idle, "reset_mask": is_played}
    )
    running = np.flatnonzero(is_played)
    episodes, seconds = bare.episodes(running), np.zeros(len(planned))
    agent.begin_all(seeds=seeds, bounds=[episode.scene.bounds for episode in episodes])
    observations, rewards = rows_of(observations, running), np.array([episode.view.reward for episode in episodes])
    while running.size:
        start_s = time.perf_counter()
        actions = agent.act_all(observations, rewards, running)
        observations, rewards, terminated, truncated, _ = step_each(envs, actions, running)
        seconds[running] += (time.perf_counter() - start_s) / running.size
        goes_on = ~(terminated | truncated)
        observations, rewards, running = rows_of(observations, goes_on), rewards[goes_on], running[goes_on]
    # Only some agents predict their errors.
    expected = getattr(agent, "expected_errors", np.full((len(planned), 2), None)).tolist()
    return [_result(*each) for each in zip(episodes, seeds, seconds.tolist(), expected, strict=True)]


def play(
    agent: Agent, env: Env, volume_name: str, seed: int, look: Callable[[], object] = lambda: None
) -> EpisodeResult:
    """Play an episode.

    Args:
        agent: Agent to play the episode.
        env: An `ArmscanEnv`, with or without wrappers.
        volume_name: Name of one of the environment's volumes.
        seed: Seed of the episode.
        look: Function called at the start and after every step.
    """
    observation, info = env.reset(seed=seed, options={"volume": volume_name})
    look()
    episode: Episode = env.get_wrapper_attr("episode")
    agent.begin(seed=seed, bounds=episode.scene.bounds)
    reward, ended = float(info["reward"]), False
    start_s = time.perf_counter()
    while not ended:
        observation, received, terminated, truncated, _ = env.step(agent.act(observation, reward))
        reward, ended = float(received), terminated or truncated
        look()
    seconds = time.perf_counter() - start_s
    expected = getattr(agent, "expected_error", None) or (None, None)
    return _result(episode, seed, seconds, expected)


def _result(episode: Episode, seed: int, seconds: float, expected: Sequence[float | None]) -> EpisodeResult:
    """Return the result of a finished episode.

    Args:
        episode: Finished episode.
        seed: Seed of its reset.
        seconds: Wall time of all its steps, in seconds.
        expected: Errors that the agent predicts for its last plane, in mm and degrees, or None and None.
    """
    # The first reward is the start's.
    _, *rewards = episode.rewards
    distance_mm, distance_deg = episode.distance
    shown = episode.view.slice_xz, episode.optimal_xz
    dice = tissue_dice(*shown)
    nerve_mm2, nerve_percent = nerve_area_error(*shown, episode.scene.volume.pixel_mm)
    return EpisodeResult(
        volume=episode.scene.volume.name,
        subject=episode.scene.volume.subject,
        seed=seed,
        n_steps=episode.n_steps,
        is_success=episode.is_solved,
        starts_solved=episode.starts_solved,
        episode_return=sum(rewards),
        final_reward=rewards[-1],
        best_reward=max(rewards),
        distance_mm=distance_mm,
        distance_deg=distance_deg,
        seconds_per_plane=seconds / episode.n_steps,
        nerve_area_error_mm2=nerve_mm2,
        nerve_area_error_percent=nerve_percent,
        expected_mm=expected[0],
        expected_deg=expected[1],
        **{f"dice_{tissue}": value for tissue, value in dice.items()},
    )

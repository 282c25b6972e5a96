"""Agents that play many episodes side by side."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from armscan.agents.protocols import Agent
from armscan.envs.actions import ActionBounds
from armscan.envs.history import rows_of
from armscan.envs.rules import Observed
from armscan.utils.arrays import FloatArray


@runtime_checkable
class BatchAgent(Protocol):
    """Agent that plays many episodes at once, each bit for bit as if it were played alone."""

    def begin_all(self, *, seeds: Sequence[int], bounds: Sequence[ActionBounds]) -> None:
        """Begin an episode for each seed; see `Agent.begin`."""

    def act_all(self, observations: Observed, rewards: FloatArray, episodes: NDArray[np.int64]) -> NDArray[Any]:
        """Return the next action of some of the episodes, shape (n, n_action); see `Agent.act`.

        Args:
            observations: Observation of each current plane, shape (n, ...).
            rewards: Reward of each plane, shape (n,), in [-1, 0].
            episodes: Number of each episode, its index among the seeds, shape (n,).
        """


class OneAtATime:
    """Batch agent made of copies of an agent, one for each episode.

    Args:
        agent: Agent to copy; it does not change.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._copies: list[Agent] = []

    def begin_all(self, *, seeds: Sequence[int], bounds: Sequence[ActionBounds]) -> None:
        """See `BatchAgent.begin_all`."""
        self._copies = [copy(self._agent) for _ in seeds]
        for agent, seed, its_bounds in zip(self._copies, seeds, bounds, strict=True):
            agent.begin(seed=seed, bounds=its_bounds)

    def act_all(self, observations: Observed, rewards: FloatArray, episodes: NDArray[np.int64]) -> NDArray[Any]:
        """See `BatchAgent.act_all`."""
        each = enumerate(zip(episodes.tolist(), rewards.tolist(), strict=True))
        return np.array(
            [self._copies[episode].act(rows_of(observations, row), reward) for row, (episode, reward) in each]
        )


def batch_agent(agent: Agent) -> BatchAgent:
    """Return an agent that plays many episodes at once: the given one, or copies of it, one for each episode."""
    return agent if isinstance(agent, BatchAgent) else OneAtATime(agent)

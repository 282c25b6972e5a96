"""Frame stack and memory of the best actions for many environments."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from armscan.envs.history import BestPairs, FrameHistory, Mask, boxes_of, observation_of, parts_of, space_of
from armscan.envs.rules import Observed
from armscan.envs.vector_env import VectorStep, reset_each
from armscan.envs.wrappers import MOST_KEPT, check_env, with_memory, with_memory_box
from armscan.utils.validation import check_int


class _VectorRemembering(VectorWrapper, ABC):
    """A wrapper whose observations depend on those before them in the episodes."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(check_env(env, VectorEnv))
        self._has_ended = np.zeros(env.num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start episodes."""
        observations, infos = reset_each(self.env, seed, options)
        is_first = infos["_reward"]
        self._has_ended &= ~is_first
        self._refill(observations, infos, is_first)
        return self._remembering(observations), infos

    def step(self, actions: Any) -> VectorStep:
        """Take a step in every environment."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        self._push(observations, infos)
        if self._has_ended.any():
            self._refill(observations, infos, self._has_ended)
        self._has_ended = terminated | truncated
        return self._remembering(observations), rewards, terminated, truncated, infos

    @abstractmethod
    def _refill(self, observations: Observed, infos: dict[str, Any], is_first: Mask) -> None:
        """Begin anew what is remembered of some environments."""

    @abstractmethod
    def _push(self, observations: Observed, infos: dict[str, Any]) -> None:
        """Take a step of every environment into what is remembered."""

    @abstractmethod
    def _remembering(self, observations: Observed) -> Observed:
        """Return the observations with what is remembered."""


class VectorFrameStack(_VectorRemembering):
    """`FrameStack` for many environments.

    Args:
        env: the environments.
        stack: as in `FrameStack`.
        exclude: as in `FrameStack`.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], stack: int, *, exclude: Collection[str] = ()) -> None:
        super().__init__(env)
        boxes = boxes_of(env.single_observation_space, "VectorFrameStack")
        self._history = FrameHistory(
            boxes, check_int("stack", stack, at_least=1, at_most=MOST_KEPT), exclude, env.num_envs
        )
        self.single_observation_space = space_of(self._history.boxes)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def _refill(self, observations: Observed, infos: dict[str, Any], is_first: Mask) -> None:
        self._history.refill(parts_of(observations), is_first)

    def _push(self, observations: Observed, infos: dict[str, Any]) -> None:
        self._history.push(parts_of(observations))

    def _remembering(self, observations: Observed) -> Observed:
        return observation_of(self._history.stack_frames(parts_of(observations)))


class VectorBestActionMemory(_VectorRemembering):
    """`BestActionMemory` for many environments.

    Args:
        env: the environments.
        memory: as in `BestActionMemory`.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], memory: int) -> None:
        super().__init__(env)
        n_free = int(np.prod(env.single_action_space.shape or ()))
        self._best = BestPairs(check_int("memory", memory, at_least=1, at_most=MOST_KEPT), n_free, env.num_envs)
        boxes = boxes_of(env.single_observation_space, "VectorBestActionMemory")
        self.single_observation_space = space_of(with_memory_box(boxes, self._best))
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def _refill(self, observations: Observed, infos: dict[str, Any], is_first: Mask) -> None:
        self._best.refill(infos["action"], infos["reward"], is_first)

    def _push(self, observations: Observed, infos: dict[str, Any]) -> None:
        self._best.push(infos["action"], infos["reward"])

    def _remembering(self, observations: Observed) -> Observed:
        return observation_of(with_memory(parts_of(observations), self._best.flat()))

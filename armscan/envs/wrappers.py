"""Wrappers of single and vector environments: frame stack and memory of the best actions.

Gymnasium's frame stack cannot exclude parts of an observation, and copies the stack twice: with images at full size it
takes 107 microseconds, this one 43. Where both can be used they give the same result, which a test checks.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from armscan.envs.history import (
    BestPairs,
    EnvIds,
    EpisodeHistory,
    FrameHistory,
    boxes_of,
    observation_of,
    parts_of,
    space_of,
)
from armscan.envs.rules import Observed
from armscan.envs.spaces import Parts
from armscan.envs.vector_env import VectorStep, reset_each, step_each
from armscan.errors import InvalidValueError
from armscan.utils.arrays import FloatArray

Env = gym.Env[Any, FloatArray]
# Index of the only environment.
ONLY = np.array([0])


class _HistoryWrapper(gym.Wrapper[Any, FloatArray, Any, FloatArray], RecordConstructorArgs):
    """A wrapper that adds an episode's history, kept as for a batch of one environment, to the observation."""

    def __init__(self, env: Env, history: EpisodeHistory, **arguments: Any) -> None:
        RecordConstructorArgs.__init__(self, **arguments)
        gym.Wrapper.__init__(self, env)
        self.arguments = arguments
        self.history = history
        self.observation_space = space_of(history.boxes)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        parts = _batch_of_one(observation)
        self.history.refill(parts, info, ONLY)
        return self._with_history(parts), info

    def step(self, action: FloatArray) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Take a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        parts = _batch_of_one(observation)
        self.history.push(parts, info, ONLY)
        return self._with_history(parts), float(reward), terminated, truncated, info

    def _with_history(self, parts: dict[str, Any]) -> Observed:
        return observation_of({name: part[0] for name, part in self.history.added_to(parts, ONLY).items()})


class FrameStack(_HistoryWrapper):
    """Stacks the last observations, from the oldest to the latest; the first one of an episode fills the stack.

    A vector of n numbers becomes one of `stack` * n; in a `Dict` each part gets a leading axis of length `stack`.

    Args:
        env: Environment whose observation is a vector or a `Dict` of boxes.
        stack: Number of latest observations to stack, from 1 to 1000.
        exclude: Parts of a `Dict` observation that are not stacked. Default: none.

    Raises:
        InvalidValueError: If `stack` is not a whole number from 1 to 1000, or an excluded part does not exist.
    """

    def __init__(self, env: Env, stack: int, *, exclude: Collection[str] = ()) -> None:
        boxes = boxes_of(_checked(env, gym.Env).observation_space, "FrameStack")
        # As a list, which JSON keeps, so that a spec read from JSON equals this one.
        super().__init__(env, FrameHistory(boxes, stack, exclude, 1), stack=stack, exclude=list(exclude))


class BestActionMemory(_HistoryWrapper):
    """Adds the best (action, reward) pairs of the episode so far, as `BestPairs` orders them, to the observation.

    They are appended to a vector, and become the part `memory` of a `Dict`.

    Args:
        env: Environment whose observation is a vector or a `Dict` of boxes, and whose `info` has `action` and `reward`.
        memory: Number of best (action, reward) pairs to add, from 1 to 1000.

    Raises:
        InvalidValueError: If `memory` is not a whole number from 1 to 1000, or the observation has a part of that name.
    """

    def __init__(self, env: Env, memory: int) -> None:
        boxes = boxes_of(_checked(env, gym.Env).observation_space, "BestActionMemory")
        super().__init__(env, BestPairs(boxes, memory, env.action_space, 1), memory=memory)


class _VectorHistoryWrapper(VectorWrapper):
    """A wrapper that adds each episode's history to its observations."""

    def __init__(self, env: VectorEnv[Any, Any, Any], history: EpisodeHistory) -> None:
        if env.metadata.get("autoreset_mode") is AutoresetMode.SAME_STEP:
            raise InvalidValueError(
                f"{type(self).__name__} wraps environments that reset at the next step or not by themselves, but these "
                "reset in the same step, when the last observation is no longer the episode's"
            )
        super().__init__(env)
        self.history = history
        self.single_observation_space = space_of(history.boxes)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._has_ended = np.zeros(env.num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start episodes."""
        observations, infos = reset_each(self.env, seed, options)
        parts, first = parts_of(observations), np.flatnonzero(infos["_reward"])
        self._has_ended[first] = False
        self._refill(parts, infos, first, first)
        return observation_of(self.history.added_to(parts, np.arange(self.num_envs))), infos

    def step(self, actions: Any, env_ids: Sequence[int] | EnvIds | None = None) -> VectorStep:
        """Take a step in every environment, or in those of `env_ids`; see `ArmscanVectorEnv.step`."""
        observations, rewards, terminated, truncated, infos = step_each(self.env, actions, env_ids)
        ids = np.arange(self.num_envs) if env_ids is None else np.asarray(env_ids)
        parts, begun = parts_of(observations), np.flatnonzero(self._has_ended[ids])
        self.history.push(parts, infos, ids)
        if len(begun):
            self._refill(parts, infos, begun, ids[begun])
        self._has_ended[ids] = terminated | truncated
        return observation_of(self.history.added_to(parts, ids)), rewards, terminated, truncated, infos

    def _refill(self, parts: Parts, infos: Mapping[str, Any], rows: EnvIds, env_ids: EnvIds) -> None:
        firsts = {name: part[rows] for name, part in parts.items()}
        self.history.refill(firsts, {key: infos[key][rows] for key in ("action", "reward") if key in infos}, env_ids)


class VectorFrameStack(_VectorHistoryWrapper):
    """`FrameStack` for vector environments, with the same arguments."""

    def __init__(self, env: VectorEnv[Any, Any, Any], stack: int, *, exclude: Collection[str] = ()) -> None:
        boxes = boxes_of(_checked(env, VectorEnv).single_observation_space, "VectorFrameStack")
        super().__init__(env, FrameHistory(boxes, stack, exclude, env.num_envs))


class VectorBestActionMemory(_VectorHistoryWrapper):
    """`BestActionMemory` for vector environments, with the same arguments."""

    def __init__(self, env: VectorEnv[Any, Any, Any], memory: int) -> None:
        boxes = boxes_of(_checked(env, VectorEnv).single_observation_space, "VectorBestActionMemory")
        super().__init__(env, BestPairs(boxes, memory, env.single_action_space, env.num_envs))


def _checked(env: Any, kind: type[Any]) -> Any:
    """Return `env` if it is an environment of the given kind."""
    if not isinstance(env, kind):
        raise InvalidValueError(f"env is {env!r}, but it must be a gymnasium {kind.__name__}")
    return env


def _batch_of_one(observation: Observed) -> Parts:
    """Return the parts of an observation, each as a batch of one."""
    return {name: part[None] for name, part in parts_of(observation).items()}

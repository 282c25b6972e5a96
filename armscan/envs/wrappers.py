"""What is put around the environment: memory of the best actions, and the making of a whole stack of wrappers."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, FrameStackObservation

from armscan.checks import check_int
from armscan.envs.env import ArmscanEnv, Volumes
from armscan.envs.observations import FloatVector
from armscan.volumes.plane import FloatArray


class BestActionMemory(gym.Wrapper[FloatVector, FloatArray, FloatVector, FloatArray]):
    """Appends the best (action, reward) pairs of the episode so far to a flat observation.

    The pairs are ordered from the best to the worst, among equal rewards the earlier first. At reset all of them are
    the first plane's; a new pair enters only if its reward beats the worst one kept.

    Args:
        env: an environment with a flat observation and an `info` with `action` and `reward`.
        size: how many pairs are kept.

    Raises:
        InvalidValueError: if `size` is not a whole number of at least 1.
    """

    def __init__(self, env: gym.Env[FloatVector, FloatArray], size: int) -> None:
        super().__init__(env)
        self.size = check_int("memory", size, at_least=1)
        flat, action = env.observation_space, env.action_space
        assert isinstance(flat, spaces.Box)
        assert isinstance(action, spaces.Box)
        low = np.concatenate([flat.low, np.tile([*action.low, -1.0], self.size)]).astype(np.float32)
        high = np.concatenate([flat.high, np.tile([*action.high, 0.0], self.size)]).astype(np.float32)
        self.observation_space = spaces.Box(low, high, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatVector, dict[str, Any]]:
        """Starts an episode, every pair being the first plane's."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._pairs = np.tile(_pair(info), (self.size, 1))
        return self._remembering(observation), info

    def step(self, action: FloatArray) -> tuple[FloatVector, float, bool, bool, dict[str, Any]]:
        """Steps, and remembers the plane if it is among the best."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        pair = _pair(info)
        if pair[-1] > self._pairs[-1, -1]:
            self._pairs[-1] = pair
            self._pairs = self._pairs[np.argsort(-self._pairs[:, -1], kind="stable")]
        return self._remembering(observation), float(reward), terminated, truncated, info

    def _remembering(self, observation: FloatVector) -> FloatVector:
        return np.concatenate([observation, self._pairs.ravel()])


def _pair(info: dict[str, Any]) -> FloatVector:
    """One row of the memory: the normalised free components, then the reward."""
    return np.append(info["action"], np.float32(info["reward"])).astype(np.float32)


def make_armscan_env(
    volumes: Volumes = None, *, stack: int = 1, memory: int = 0, **kwargs: Any
) -> gym.Env[FloatVector, FloatArray]:
    """Makes an environment with its wrappers; this is what `gymnasium.make("armscan/Armscan-v0", ...)` calls.

    Args:
        volumes: as in `ArmscanEnv`.
        stack: how many of the last observations are stacked, the first one filling the stack at reset.
        memory: how many of the best (action, reward) pairs are appended, after the stack; 0 for none.
        **kwargs: the other arguments of `ArmscanEnv`.

    Returns:
        The environment, its observation flat.
    """
    env: gym.Env[FloatVector, FloatArray] = ArmscanEnv(volumes, **kwargs)
    if check_int("stack", stack, at_least=1) > 1:
        env = FlattenObservation(FrameStackObservation(env, stack, padding_type="reset"))
    if check_int("memory", memory, at_least=0) > 0:
        env = BestActionMemory(env, memory)
    return env

"""Adapter from the vector environment to Tianshou's interface."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from tianshou.data import Batch
from tianshou.env import BaseVectorEnv

from armscan.envs.history import Mask
from armscan.envs.rules import Observed
from armscan.envs.vector_env import ArmscanVectorEnv, reset_each
from armscan.utils.arrays import FloatArray

Ids = int | list[int] | NDArray[np.int64] | None


class TianshouVectorEnv(BaseVectorEnv):
    """A Gymnasium vector environment without autoreset, under the interface of Tianshou's vector environments.

    `info` is left out, because a replay buffer would store it with every transition.

    Args:
        envs: Vector environment to adapt.

    Attributes:
        n_ended: Number of episodes that have ended since it was set to 0.
        n_successes: Number of these episodes that ended in success.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        self.env_num = envs.num_envs
        self.is_async = False
        self.is_closed = False
        self._envs = envs
        if isinstance(bare := envs.unwrapped, ArmscanVectorEnv):
            # `is_success` is read here; the wrappers require the others.
            bare.info_keys = ("is_success",) if bare is envs else ("action", "reward", "is_success")
        self._seeds: list[int | None] | None = None
        self.n_ended = self.n_successes = 0
        self._action_spaces = [deepcopy(envs.single_action_space) for _ in range(envs.num_envs)]

    def get_env_attr(self, key: str, id: Ids = None) -> list[Any]:  # noqa: A002 - Tianshou's name
        """Return the action space of each environment, the only attribute that Tianshou asks for."""
        assert key == "action_space"
        return list(self._action_spaces)

    def reset(self, env_id: Ids = None, **kwargs: Any) -> tuple[Any, NDArray[Any]]:
        """Start episodes; return the first observations of these environments, and infos with only their IDs."""
        ids = np.arange(self.env_num) if env_id is None else np.atleast_1d(env_id)
        observations = self.begin(np.isin(np.arange(self.env_num), ids))
        return batched(observations)[ids], self._no_info(ids)

    def step(self, action: Any, id: Ids = None) -> tuple[Any, ...]:  # noqa: A002
        """Take a step in all environments."""
        assert id is None or len(np.atleast_1d(id)) == self.env_num, "the environments are only stepped all at once"
        observations, *outcome = self.advance(np.asarray(action))
        return batched(observations), *outcome, self._no_info(np.arange(self.env_num))

    def begin(self, mask: Mask) -> Observed:
        """Start episodes in the environments of a mask; return the observations of all environments."""
        observations, _ = reset_each(self._envs, self._seeds, {"reset_mask": mask})
        self._seeds = None
        return observations

    def advance(self, actions: NDArray[Any]) -> tuple[Observed, FloatArray, Mask, Mask]:
        """Take a step in all environments; return observations, rewards, and which have terminated or truncated."""
        observations, rewards, terminated, truncated, infos = self._envs.step(actions)
        has_ended = terminated | truncated
        self.n_ended += int(np.count_nonzero(has_ended))
        self.n_successes += int(np.count_nonzero(has_ended & infos["is_success"]))
        return observations, rewards, terminated, truncated

    def seed(self, seed: int | list[int] | None = None) -> list[list[int] | None]:
        """Seed the next reset and the random actions, with a seed for each environment."""
        assert isinstance(seed, list)
        self._seeds = list(seed)
        for space, one_seed in zip(self._action_spaces, seed, strict=True):
            space.seed(one_seed)
        return [[one_seed] for one_seed in seed]

    @staticmethod
    def _no_info(ids: NDArray[np.int64]) -> NDArray[Any]:
        return np.array([{"env_id": i} for i in ids])


def batched(observations: Observed) -> Any:
    """Return observations in the form that Tianshou indexes: an array, or a `Batch` of arrays."""
    return Batch(observations) if isinstance(observations, dict) else observations

"""Environments in which an agent corrects the planes of a plane finder."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from torch import Tensor

from armscan.agents.look_network import FinderModule, PlaneEstimate, looks_of
from armscan.envs.rules import Observed
from armscan.envs.vector_env import reset_each
from armscan.utils.arrays import FloatArray

DrawVolumes = Callable[[np.random.Generator, int], dict[str, Any] | None]


class ResidualVectorEnv(VectorWrapper):
    """Environments whose observations are a plane finder's features, and whose actions correct its planes.

    Args:
        envs: Environments of the plane finder.
        finder: Plane finder, which does not change.
        limits: Largest corrections in the frame of a look, shape (4,): sines of two tilts, mm along the normal and
            across.
        draw_volumes: Function of a NumPy generator and the number of environments that returns reset options with the
            volume of each episode, or None.
    """

    def __init__(
        self, envs: VectorEnv[Any, Any, Any], finder: FinderModule, limits: Tensor, draw_volumes: DrawVolumes
    ) -> None:
        super().__init__(envs)
        self._finder, self._limits, self._draw_volumes = finder, limits, draw_volumes
        self._rng = np.random.default_rng()
        self._estimate: PlaneEstimate | None = None
        self.single_observation_space = feature_space(finder)
        self.single_action_space = spaces.Box(-1.0, 1.0, limits.shape)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[FloatArray, dict[str, Any]]:
        """Start episodes; see `ArmscanVectorEnv.reset`."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        volumes = self._draw_volumes(self._rng, self.num_envs) or {}
        observations, infos = reset_each(self.env, seed, {**(options or {}), **volumes})
        return self._features(observations), infos

    def step(self, actions: FloatArray) -> tuple[FloatArray, Any, Any, Any, dict[str, Any]]:
        """Take a step in all environments with their corrections, shape (num_envs, 4)."""
        assert self._estimate is not None, "episodes begin with a reset"
        with torch.no_grad():
            corrections = torch.as_tensor(actions, dtype=torch.float32, device=self._limits.device)
            planes = self._finder.actions(self._estimate.moved(corrections * self._limits)).cpu().numpy()
        observations, rewards, terminated, truncated, infos = self.env.step(planes)
        return self._features(observations), rewards, terminated, truncated, infos

    def _features(self, observations: Observed) -> FloatArray:
        with torch.no_grad():
            self._estimate = self._finder.found(looks_of(observations, self._limits.device))
            return np.asarray(self._estimate.features().cpu().numpy())


def feature_space(finder: FinderModule) -> spaces.Box:
    """Return the space of one observation of `ResidualVectorEnv`."""
    return spaces.Box(-np.inf, np.inf, (finder.n_features,))

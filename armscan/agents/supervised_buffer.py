"""Observations with the optimal actions of their episodes, for supervised learning."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.envs.history import boxes_of, observation_of, parts_of
from armscan.envs.rules import Observed
from armscan.utils.arrays import FloatArray


class SupervisedBuffer:
    """Observations with the optimal actions of their episodes; new ones overwrite the oldest.

    Args:
        size: Maximum number of observations.
        space: Space of one observation.
        n_action: Number of components of an action.
    """

    def __init__(self, size: int, space: spaces.Space[Any], n_action: int) -> None:
        boxes = boxes_of(space, "agent=regression")
        self._size = size
        self._parts = {name: np.empty((size, *box.shape), box.dtype) for name, box in boxes.items()}
        self._optima = np.empty((size, n_action), np.float32)
        self._n_added = 0

    def __len__(self) -> int:
        return min(self._n_added, self._size)

    def add(self, observations: Observed, optima: FloatArray) -> None:
        """Keep a batch: observations, each part shape (n, ...), and optimal actions, shape (n, n_action)."""
        places = np.arange(self._n_added, self._n_added + len(optima)) % self._size
        for name, part in parts_of(observations).items():
            self._parts[name][places] = part
        self._optima[places] = optima
        self._n_added += len(optima)

    def draw(self, n: int, rng: np.random.Generator) -> tuple[Observed, NDArray[np.float32]]:
        """Return `n` observations and their optimal actions, shape (n, n_action), drawn with replacement."""
        places = rng.integers(len(self), size=n)
        return observation_of({name: part[places] for name, part in self._parts.items()}), self._optima[places]

    def state(self) -> dict[str, Any]:
        """Return the stored data as tensors."""
        parts = {name: torch.from_numpy(part[: len(self)]) for name, part in self._parts.items()}
        return {"parts": parts, "optima": torch.from_numpy(self._optima[: len(self)]), "n_added": self._n_added}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self._n_added = state["n_added"]
        for name, part in self._parts.items():
            part[: len(self)] = state["parts"][name].numpy()
        self._optima[: len(self)] = state["optima"].numpy()

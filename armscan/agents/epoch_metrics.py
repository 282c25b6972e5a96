"""Metrics that Tianshou's trainer reports during an epoch."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from tianshou.utils import LazyLogger


class EpochMetrics(LazyLogger):
    """Collects the reports of Tianshou's trainer during an epoch, and averages them at its end.

    Tianshou's own loggers write to TensorBoard or elsewhere at every gradient step, while training waits.
    """

    UPDATE_NAMES = (
        ("actor_loss", "update/actor_loss"),
        ("critic1_loss", "update/critic_loss"),
        ("vf_loss", "update/critic_loss"),
        ("ent_loss", "update/entropy"),
        ("alpha", "update/entropy_coefficient"),
    )

    def __init__(self) -> None:
        super().__init__()
        self._values: defaultdict[str, list[float]] = defaultdict(list)
        self._n_updates = 0

    def log_training_data(self, log_data: dict[str, Any], step: int) -> None:
        """Gather returns and lengths of the episodes that have ended."""
        self._values["train/return"].extend(log_data["returns"])
        self._values["train/length"].extend(log_data["lens"])

    def log_update_data(self, log_data: dict[str, Any], step: int) -> None:
        """Gather losses and count gradient steps; one report may hold the means of several steps."""
        n_updates = log_data.get("gradient_steps", 1)
        self._n_updates += n_updates
        for theirs, ours in self.UPDATE_NAMES:
            value = log_data.get(theirs)
            if isinstance(value, dict):
                value = value["mean"]
            if value is not None:
                self._values[ours] += [float(value)] * n_updates

    def take(self) -> dict[str, float]:
        """Return the metrics since the last call: means, the worst episode, numbers of episodes and updates."""
        metrics = {name: float(np.mean(values)) for name, values in self._values.items() if values}
        if self._values["train/length"]:
            metrics["train/length_max"] = float(np.max(self._values["train/length"]))
            metrics["train/return_min"] = float(np.min(self._values["train/return"]))
        metrics["train/episodes"] = float(len(self._values["train/length"]))
        metrics["updates"] = float(self._n_updates)
        self._values.clear()
        self._n_updates = 0
        return metrics

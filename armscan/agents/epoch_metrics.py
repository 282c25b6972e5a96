"""What Tianshou's trainer reports during an epoch."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
from tianshou.highlevel.logger import LoggerFactory
from tianshou.utils.logger.logger_base import BaseLogger


class EpochMetrics(BaseLogger):
    """Gathers what Tianshou's trainer reports during an epoch, to be taken at its end as means."""

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
        """Gather losses and count gradient steps, of which PPO reports many at once."""
        self._n_updates += log_data.get("gradient_steps", 1)
        for theirs, ours in self.UPDATE_NAMES:
            value = log_data.get(theirs)
            if isinstance(value, dict):
                value = value["mean"]
            if value is not None:
                self._values[ours].append(float(value))

    def take(self) -> dict[str, float]:
        """Return what was gathered since the last call: means, the worst episode, numbers of episodes and updates."""
        metrics = {name: float(np.mean(values)) for name, values in self._values.items() if values}
        if self._values["train/length"]:
            metrics["train/length_max"] = float(np.max(self._values["train/length"]))
            metrics["train/return_min"] = float(np.min(self._values["train/return"]))
        metrics["train/episodes"] = float(len(self._values["train/length"]))
        metrics["updates"] = float(self._n_updates)
        self._values.clear()
        self._n_updates = 0
        return metrics

    def write(self, step_type: str, step: int, data: dict[str, Any]) -> None:
        """Unused: nothing is written anywhere from here."""

    def prepare_dict_for_logging(self, log_data: dict[str, Any]) -> dict[str, Any]:
        """Return the data as it is."""
        return log_data

    def finalize(self) -> None:
        """Has nothing open."""

    def save_data(
        self,
        epoch: int,
        env_step: int,
        update_step: int,
        save_checkpoint_fn: Callable[[int, int, int], str] | None = None,
    ) -> None:
        """Unused: training keeps its own checkpoints."""

    def restore_data(self) -> tuple[int, int, int]:
        """Begin at the beginning."""
        return 0, 0, 0

    @staticmethod
    def restore_logged_data(log_path: str) -> dict[str, Any]:
        """Has nothing to restore."""
        return {}


class EpochMetricsFactory(LoggerFactory):
    """Gives a Tianshou experiment the logger whose figures a learner hands on: to training, and so to tracking.

    Tianshou's own loggers write to TensorBoard or elsewhere at every gradient step, while training waits.
    """

    def create_logger(
        self, log_dir: str, experiment_name: str, run_id: str | None, config_dict: dict[str, Any] | None = None
    ) -> EpochMetrics:
        """Return a logger that has gathered nothing yet; the arguments are for those that write."""
        return EpochMetrics()

    def get_logger_class(self) -> type[EpochMetrics]:
        """Return the class of the logger."""
        return EpochMetrics

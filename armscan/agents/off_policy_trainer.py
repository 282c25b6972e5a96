"""Tianshou's off-policy trainer, with a fractional update-to-data ratio."""

from __future__ import annotations

from typing import Any

from tianshou.algorithm.algorithm_base import TrainingStats
from tianshou.data import CollectStatsBase
from tianshou.trainer import OffPolicyTrainer, OffPolicyTrainerParams

from armscan.agents.compiled_sac import CompiledSAC


class EvenUpdatesTrainer(OffPolicyTrainer):
    """Tianshou's trainer, with gradient steps in exact proportion to environment steps.

    Tianshou rounds the gradient steps of every collection separately, and refuses a collection without any. Here the
    steps due are counted from the first collection on, so a resumed training takes the same gradient steps as one that
    was never interrupted. No progress bar is shown.

    Args:
        algorithm: Algorithm to train.
        params: Parameters of the trainer.
        learning_starts: Number of environment steps before the first collection.
    """

    def __init__(self, algorithm: CompiledSAC, params: OffPolicyTrainerParams, learning_starts: int) -> None:
        super().__init__(algorithm, params)
        self._learning_starts = learning_starts

    def _update_step(self, collect_stats: CollectStatsBase) -> TrainingStats:
        """Take the gradient steps that are due since the previous collection; return their statistics."""
        collector = self.params.training_collector
        n_env_steps = collector.collect_step - self._learning_starts
        n_due = self._n_due(n_env_steps) - self._n_due(n_env_steps - collect_stats.n_collected_steps)
        stats = TrainingStats()
        if n_due and self.algorithm.fallback_reason is None:
            stats = self.algorithm.update_repeatedly(collector.buffer, self.params.batch_size, n_due)
            # Tianshou's own method deep-copies the statistics, and smooths losses for its progress bar.
            self._logger.log_update_data(vars(stats), self._current_update_step)
            return stats
        for _ in range(n_due):
            stats = self._sample_and_update(collector.buffer)
        return stats

    def _create_epoch_pbar_data_dict(self, training_step_result: Any) -> dict[str, str]:
        return {}

    def _n_due(self, n_env_steps: int) -> int:
        # Rounded, because a whole product may come out just below its value.
        return round(self.params.update_step_num_gradient_steps_per_sample * n_env_steps)

"""A Tianshou experiment behind the few methods that training needs of a learner."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tianshou.data import Batch
from tianshou.highlevel.experiment import Experiment
from tianshou.highlevel.persistence import PolicyPersistence
from tianshou.utils.logger.logger_base import BaseLogger

from armscan.envs.task import Observed
from armscan.errors import DivergedError
from armscan.volumes.plane import FloatArray


class EpochMetrics(BaseLogger):
    """Gathers what Tianshou's trainer reports during an epoch, to be taken at its end as means."""

    UPDATE_NAMES = (
        ("actor_loss", "update/actor_loss"),
        ("critic1_loss", "update/critic_loss"),
        ("alpha", "update/entropy_coefficient"),
    )

    def __init__(self) -> None:
        super().__init__()
        self._values: defaultdict[str, list[float]] = defaultdict(list)

    def log_training_data(self, log_data: dict[str, Any], step: int) -> None:
        """Gathers returns and lengths of the episodes that have ended."""
        self._values["train/return"].extend(log_data["returns"])
        self._values["train/length"].extend(log_data["lens"])

    def log_update_data(self, log_data: dict[str, Any], step: int) -> None:
        """Gathers losses."""
        for theirs, ours in self.UPDATE_NAMES:
            value = log_data.get(theirs)
            if isinstance(value, dict):
                value = value["mean"]
            if value is not None:
                self._values[ours].append(float(value))

    def take(self) -> dict[str, float]:
        """Returns the means since the last call, and how many episodes have ended."""
        metrics = {name: float(np.mean(values)) for name, values in self._values.items() if values}
        metrics["train/episodes"] = float(len(self._values["train/length"]))
        self._values.clear()
        return metrics

    def write(self, step_type: str, step: int, data: dict[str, Any]) -> None:
        """Unused: nothing is written anywhere from here."""

    def prepare_dict_for_logging(self, log_data: dict[str, Any]) -> dict[str, Any]:
        """Returns the data as it is."""
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
        """Begins at the beginning."""
        return 0, 0, 0

    @staticmethod
    def restore_logged_data(log_path: str) -> dict[str, Any]:
        """Has nothing to restore."""
        return {}


class TianshouLearner:
    """A learner made of a Tianshou experiment.

    The experiment's own test collector, persistence and progress bars are left out: evaluation, checkpoints and
    progress are the same for every agent, and belong to training.

    Args:
        experiment: as its builder gives it.
        random_env_steps: steps with random actions before the first update.
    """

    def __init__(self, experiment: Experiment, *, random_env_steps: int) -> None:
        world = experiment.create_experiment_world()
        self._metrics = EpochMetrics()
        world.logger = self._metrics
        world.test_collector = None
        trainer = experiment.algorithm_factory.create_trainer(world, _NoPersistence())
        trainer.params.show_progress = False
        trainer.reset(reset_collectors=False)
        assert world.training_collector is not None
        self._collector = world.training_collector
        # Tianshou searches the whole replay buffer for NaNs at every collection, which costs more the fuller it is; the
        # environment's observations are clipped counts and finite by construction.
        vars(self._collector.buffer)["hasnull"] = lambda: False
        self._algorithm = world.algorithm
        self._trainer = trainer
        self._random_env_steps = random_env_steps

    @property
    def n_env_steps(self) -> int:
        """Environment steps taken so far, the random ones included."""
        return int(self._collector.collect_step)

    def warm_up(self) -> None:
        """Fills the replay buffer with random steps."""
        self._collector.collect(n_step=self._random_env_steps, random=True)

    def learn(self, n_env_steps: int) -> dict[str, float]:
        """Learns for one epoch of at least `n_env_steps`; returns its training metrics by name.

        Raises:
            DivergedError: if the weights are not finite afterwards.
        """
        self._trainer.params.epoch_num_steps = n_env_steps
        n_before, start_s = self.n_env_steps, time.perf_counter()
        try:
            self._trainer.execute_epoch()
        except ValueError as error:
            # torch's distributions refuse the NaNs of a policy that has diverged.
            self._check_weights(error)
            raise
        self._check_weights()
        metrics = self._metrics.take()
        metrics["speed/env_steps_per_s"] = (self.n_env_steps - n_before) / (time.perf_counter() - start_s)
        return metrics

    def _check_weights(self, cause: ValueError | None = None) -> None:
        if not all(torch.isfinite(weights).all() for weights in self._algorithm.parameters()):
            raise DivergedError(
                f"learning has diverged: after {self.n_env_steps} environment steps the networks' weights are not "
                "finite any more; a smaller agent.lr or agent.entropy_lr may help"
            ) from cause

    def act(self, observation: Observed) -> FloatArray:
        """Returns the deterministic policy's action, shape (n_free,)."""
        policy = self._algorithm.policy
        with torch.no_grad():
            result = policy(Batch(obs=_batch_of_one(observation), info=Batch()))
        return np.asarray(policy.map_action(result.act.cpu().numpy())[0])

    def state(self) -> dict[str, Any]:
        """Returns the weights and the optimisers' state."""
        return dict(self._algorithm.state_dict())  # type: ignore[no-untyped-call]

    def load_state(self, state: dict[str, Any]) -> None:
        """Takes over weights and optimisers' state."""
        self._algorithm.load_state_dict(dict(state))


def _batch_of_one(observation: Observed) -> Any:
    if isinstance(observation, dict):
        return Batch({name: part[None] for name, part in observation.items()})
    return observation[None]


class _NoPersistence(PolicyPersistence):
    """Keeps Tianshou from saving: without test steps there is no best policy for it to save."""

    def get_save_best_fn(self, world: Any) -> None:  # type: ignore[override]
        return None

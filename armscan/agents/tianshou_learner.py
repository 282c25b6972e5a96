"""Adapter from Tianshou's trainers to the `Learner` interface."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import tianshou.trainer
import torch
from numpy.typing import NDArray
from tianshou.algorithm import algorithm_base
from tianshou.algorithm.algorithm_base import Policy as TianshouPolicy
from tianshou.data import collector
from tianshou.trainer import OffPolicyTrainer, OnPolicyTrainer

from armscan.agents.base_learner import BaseLearner, diverged, is_finite, load_into
from armscan.agents.compiled_sac import CompiledSAC
from armscan.agents.compute import Compute
from armscan.agents.epoch_metrics import EpochMetrics
from armscan.agents.hyperparameters import Parameters
from armscan.agents.inference import Inference
from armscan.agents.policy import Policy
from armscan.agents.protocols import AgentSetup
from armscan.agents.replay import Replay
from armscan.agents.step_collector import StepCollector
from armscan.agents.tianshou_envs import TianshouVectorEnv
from armscan.envs.actions import ActionBounds
from armscan.envs.rules import Observed
from armscan.utils.arrays import FloatArray

# Tianshou measures durations by the wall clock, and raises an error if it is set back. Replace it by a monotonic clock.
for _module in (algorithm_base, collector, tianshou.trainer):
    vars(_module)["time"] = SimpleNamespace(time=time.perf_counter, sleep=time.sleep)


class TianshouLearner(BaseLearner):
    """A learner made of a Tianshou trainer.

    Its test collector, persistence and progress bars are left out: evaluation, checkpoints and progress are the same
    for every agent, and belong to training.

    Every epoch begins with new episodes and seeds all random numbers with (`seed`, epoch). So a resumed training equals
    an uninterrupted one without any state of an episode.

    Args:
        trainer: Trainer of Tianshou, with `training_parameters`.
        bounded: Function that maps the mean of the policy's actions to [-1, 1], as the trainer's policy does.
        parameters: Parameters of the algorithm; learning rates are set at the beginning of each epoch.
        setup: Environments, spaces, budget and seed of the agent.
        learning_starts: Number of environment steps with random actions before the first update. Default: 0.
    """

    def __init__(
        self,
        trainer: OnPolicyTrainer | OffPolicyTrainer,
        *,
        bounded: Callable[[torch.Tensor], torch.Tensor],
        parameters: Parameters,
        setup: AgentSetup,
        learning_starts: int = 0,
    ) -> None:
        super().__init__(setup)
        trainer.reset(reset_collectors=False)
        self._trainer = trainer
        self._algorithm: Any = trainer.algorithm
        collector: Any = trainer.params.training_collector
        self._collector = collector
        self._replay: Replay = collector.buffer
        self._envs: TianshouVectorEnv = collector.env
        self._metrics = cast(EpochMetrics, trainer.params.logger)
        self._learning_starts = learning_starts
        self._parameters, self._bounded = parameters, bounded
        self._network = policy = self._algorithm.policy
        self._inference = Inference(policy.actor, bounded, setup.compute, is_sampling=not policy.deterministic_eval)
        critics = [module for name, module in self._algorithm.named_children() if name.startswith("critic")]
        # The target critics included.
        for network in (policy.actor, *critics):
            setup.compute.apply_to(network)

    @property
    def n_env_steps(self) -> int:
        """Environment steps taken so far, the random ones included."""
        return int(self._collector.collect_step)

    @property
    def actor(self) -> torch.nn.Module:
        """Actor, from observations to mean and standard deviation of actions."""
        actor: torch.nn.Module = self._algorithm.policy.actor
        return actor

    @property
    def env_steps_at_once(self) -> int:
        """Environment steps of one collection."""
        return int(self._trainer.params.collection_step_num_env_steps or 0)

    @property
    def update_note(self) -> str:
        """Return how gradient steps are computed: `compiled`, or `Tianshou`, with the GPU and the reason, if any."""
        tianshou = " ".join(filter(None, ["Tianshou", super().update_note]))
        if not isinstance(self._algorithm, CompiledSAC):
            return tianshou
        reason = self._algorithm.fallback_reason
        return "compiled" if reason is None else f"{tianshou}, because {reason}"

    @property
    def validation_note(self) -> str:
        """Return how the actions of evaluations are chosen: `deterministic` or `sampled`."""
        return "deterministic" if self._algorithm.policy.deterministic_eval else "sampled"

    @property
    def warm_up_note(self) -> str | None:
        """Return a note on the number of random steps before the first update; None if there are none."""
        return f"{self._learning_starts:,} before the first update" if self._learning_starts else None

    def warm_up(self) -> None:
        """Fill the replay buffer with random steps."""
        self._begin_epoch()
        if self._learning_starts:
            self._collector.collect(n_step=self._learning_starts, random=True)

    def learn(self, n_env_steps: int) -> dict[str, float]:
        """Learn for one epoch of at least `n_env_steps`; return its training metrics by name.

        Raises:
            DivergedError: If the weights are not finite afterwards.
        """
        self._n_epochs += 1
        self._begin_epoch()
        self._trainer.params.epoch_num_steps = n_env_steps
        n_before, start_s = self.n_env_steps, time.perf_counter()
        try:
            self._trainer.execute_epoch()
        except ValueError as error:
            # torch's distributions refuse NaN, which a diverged policy returns.
            self._check_weights(error)
            raise
        self._check_weights()
        metrics = self._metrics.take()
        seconds = time.perf_counter() - start_s
        metrics["speed/env_steps_per_s"] = (self.n_env_steps - n_before) / seconds
        metrics["speed/updates_per_s"] = metrics.pop("updates") / seconds
        metrics["replay_size"] = float(len(self._replay))
        if (n_ended := self._envs.n_ended) > 0:
            metrics["train/success_rate"] = self._envs.n_successes / n_ended
        return metrics

    def _begin_epoch(self) -> None:
        """Restart episodes and random numbers, with the current learning rates."""
        self._replay.cut_off()
        for_numpy, for_replay, for_envs = self._epoch_seeds()
        # Tianshou shuffles with NumPy's global generator.
        np.random.seed(for_numpy.generate_state(1))  # noqa: NPY002
        self._replay.seed(int(for_replay.generate_state(1)[0]))
        self._envs.seed([int(word) for word in for_envs.generate_state(self._collector.env_num)])
        self._envs.n_ended = self._envs.n_successes = 0
        self._collector.reset_env()
        self._set_lr(self._parameters.lr_after(self.n_env_steps, self._total_env_steps))

    def _lr_groups(self) -> list[dict[str, Any]]:
        return [group for optimiser in self._algorithm._optimizers for group in optimiser._optim.param_groups]

    def _check_weights(self, cause: ValueError | None = None) -> None:
        if not is_finite(self._algorithm):
            or_entropy = " or agent.ent_coef_lr" if _entropy_optimiser(self._algorithm) else ""
            raise diverged(self.n_env_steps, f"agent.lr{or_entropy}") from cause

    def begin(self, *, seed: int, bounds: ActionBounds) -> None:
        """Begin an episode; random numbers are drawn in it only if evaluations sample actions."""
        self._inference.begin([seed])

    def act(self, observation: Observed, reward: float) -> NDArray[np.float32]:
        """Return the policy's action, shape (n_action,)."""
        return self._inference.action(observation)

    def begin_all(self, *, seeds: Sequence[int], bounds: Sequence[ActionBounds]) -> None:
        """Begin an episode for each seed."""
        self._inference.begin(seeds)

    def act_all(self, observations: Observed, rewards: FloatArray, episodes: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the policy's action in each episode, shape (n, n_action)."""
        return self._inference.actions(observations, episodes)

    def policy(self) -> Policy:
        """Return a copy of the actor that `act` uses; it returns deterministic actions."""
        policy = self._algorithm.policy
        return Policy(policy.actor, self._bounded, self._compute, is_sampling=not policy.deterministic_eval)

    def state(self) -> dict[str, Any]:
        """Return networks, optimisers, replay buffer and counters."""
        self._replay.cut_off()
        return {
            "algorithm": dict(self._algorithm.state_dict()),
            "entropy_optimiser": optimiser.state_dict() if (optimiser := _entropy_optimiser(self._algorithm)) else {},
            "replay": self._replay.state(),
            "n_env_steps": self.n_env_steps,
            "n_epochs": self._n_epochs,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned.

        Raises:
            CheckpointError: If the state belongs to another agent.
        """
        load_into(self._algorithm, dict(state["algorithm"]))
        if optimiser := _entropy_optimiser(self._algorithm):
            # Keep the configured learning rate, which a schedule may have changed.
            lr = optimiser.param_groups[0]["lr"]
            optimiser.load_state_dict(state["entropy_optimiser"])
            optimiser.param_groups[0]["lr"] = lr
        self._replay.load_state(state["replay"])
        self._collector.collect_step = state["n_env_steps"]
        self._n_epochs = state["n_epochs"]


def training_parameters(
    policy: TianshouPolicy, envs: TianshouVectorEnv, replay: Replay, compute: Compute
) -> dict[str, Any]:
    """Return the parameters that Tianshou's trainers share."""
    return {
        "training_collector": StepCollector(policy, envs, replay, compute),
        "logger": EpochMetrics(),
        "verbose": False,
        "show_progress": False,
    }


def _entropy_optimiser(algorithm: Any) -> torch.optim.Optimizer | None:
    """Return the optimiser of a learned entropy coefficient, which Tianshou leaves out of an algorithm's state."""
    return getattr(getattr(algorithm, "alpha", None), "_optim", None)

"""Trials that only wait: without training, only the platform's overhead remains of a study."""

from __future__ import annotations

from omegaconf import DictConfig

from armscan.experiment.build import check_keys
from armscan.sweeps.tasks.attempt import Attempt
from benchmarks.sweeps.wait import N_PARTS, Waited, wait

STEPS_A_PART = 100


class Sleeping:
    """A task that waits and reports ten times; see `wait`."""

    final_metric = "test/mean_steps"

    def __init__(self, shortest_s: float = 1.0, longest_s: float = 5.0) -> None:
        self._shortest_s, self._longest_s = shortest_s, longest_s

    def metrics(self, config: DictConfig) -> tuple[str, ...]:
        """See `Task.metrics`."""
        return ("mean_steps", *Waited._fields)

    def check(self, config: DictConfig) -> None:
        """See `Task.check`."""
        check_keys(config)

    def run(self, attempt: Attempt) -> dict[str, float]:
        """Wait; return `agent.lr` as the value."""
        (seed,) = attempt.seeds
        config, _ = attempt.config(seed)
        value = float(config.agent.lr)

        def report(part: int) -> None:
            attempt.report(
                {"mean_steps": value, "mean_return": -value},
                seed=seed,
                n_env_steps=part * STEPS_A_PART,
                report_every_env_steps=STEPS_A_PART,
                total_env_steps=N_PARTS * STEPS_A_PART,
            )

        waited = wait(attempt.trial.number, self._shortest_s, self._longest_s, report)
        return {"mean_steps": value, **waited._asdict()}

    def validate(self, attempt: Attempt) -> dict[str, float]:
        """See `Task.validate`."""
        return self.run(attempt)

    def evaluate(self, attempt: Attempt) -> dict[str, float]:
        """See `Task.evaluate`."""
        return {"test/mean_steps": self.run(attempt)["mean_steps"]}

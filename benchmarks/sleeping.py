"""A trial that only takes its time: what is left of a study without training is the platform."""

from __future__ import annotations

import time

from omegaconf import DictConfig

from armscan.building import check_keys
from armscan.sweeps.attempt import Attempt

N_REPORTS = 10


class Sleeping:
    """The task of waiting for `training.env_steps` milliseconds, with ten reports."""

    figures = ("mean_steps", "slept_s")
    judged = "test/mean_steps"

    def check(self, config: DictConfig) -> None:
        """See `Task.check`."""
        check_keys(config)

    def run(self, attempt: Attempt) -> dict[str, float]:
        """Waits; the value is what `agent.lr` is."""
        config, _ = attempt.config(attempt.seeds[0])
        n_ms, value = int(config.training.env_steps), float(config.agent.lr)
        start_s = time.perf_counter()
        for i in range(1, N_REPORTS + 1):
            until_s = start_s + n_ms / 1000 * i / N_REPORTS
            time.sleep(max(0.0, until_s - time.perf_counter()))
            figures = {"mean_steps": value, "mean_return": -value}
            at = {"n_env_steps": i * 100, "grid": 100, "total": N_REPORTS * 100}
            attempt.report(figures, seed=attempt.seeds[0], **at)
        return {"mean_steps": value, "slept_s": n_ms / 1000}

    def judge(self, attempt: Attempt) -> dict[str, float]:
        """See `Task.judge`."""
        return {"test/mean_steps": self.run(attempt)["mean_steps"]}

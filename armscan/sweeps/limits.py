"""When a study has enough: of trials, of time, of environment steps, or of failures."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from optuna.trial import FrozenTrial

from armscan.sweeps.tally import FAILURE, Tally

# After this many failures, with no trial that got anywhere, the fault is in the configuration and not in a trial.
FAILURES_AT_ONCE = 3


@dataclass(frozen=True, kw_only=True)
class Limits:
    """When a study has enough.

    Args:
        n_trials: that finish.
        max_failures: trials that may fail for good.
        max_retries: of a trial whose worker died.
        hours: wall time in which trials run; None for no limit.
        env_steps: of all trials; None for no limit.
    """

    n_trials: int
    max_failures: int = 10
    max_retries: int = 1
    hours: float | None = None
    env_steps: int | None = None

    def spent(self, tally: Tally) -> str | None:
        """Returns why no trial is to be gone on with, for time or environment steps; None where there are some left."""
        if self.hours is not None and tally.busy_hours >= self.hours:
            return f"the {self.hours:g} hours of study.hours are over"
        if self.env_steps is not None and tally.env_steps >= self.env_steps:
            return f"the {self.env_steps} environment steps of study.env_steps are taken"
        return None

    def broken(self, tally: Tally, forgiven: Collection[int]) -> str | None:
        """Returns why so many trials have failed that the study ends; None where they are few enough.

        Args:
            tally: how the study stands.
            forgiven: numbers of trials whose failures count no more.
        """
        failed = [trial for trial in tally.failed if trial.number not in forgiven]
        if len(failed) > self.max_failures:
            return f"{len(failed)} trials have failed, and at most {self.max_failures} may: {_reason(failed[-1])}"
        got_nowhere = not tally.finished and not any(trial.intermediate_values for trial in tally.all)
        if len(failed) >= FAILURES_AT_ONCE and got_nowhere:
            return f"the first {len(failed)} trials failed before they reported anything: {_reason(failed[0])}"
        return None


def _reason(trial: FrozenTrial) -> str:
    return f"trial {trial.number}: {trial.user_attrs.get(FAILURE, 'no reason is known')}"

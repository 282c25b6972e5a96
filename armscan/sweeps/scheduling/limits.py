"""Limits at which a study ends: trials, failures, time and environment steps."""

from __future__ import annotations

from collections.abc import Sequence

from optuna.trial import FrozenTrial
from pydantic import Field

from armscan.sweeps.scheduling.state import StudyState, env_steps_of
from armscan.sweeps.storage.attribute_names import FAILURE
from armscan.sweeps.storage.reports import reports_of
from armscan.utils.section import Section

# If this many trials fail before any of them reports anything, the configuration is at fault.
FAILURES_BEFORE_REPORTS = 3


class LimitReachedError(Exception):
    """The study's time or environment steps are used up, or it was stopped: the current trial is requeued."""


class Limits(Section):
    """Limits at which a study ends.

    Args:
        n_trials: Number of trials to finish, 1 or more.
        max_failures: Maximum number of failed trials, without retried ones, 0 or more; one more ends the study.
            Default: 10.
        max_retries: Number of retries of a trial whose worker died, 0 or more. Default: 1.
        timeout_hours: Maximum time in hours during which at least one trial of the search runs, above 0. Default: None,
            no limit.
        max_env_steps: Maximum environment steps of all trials of the search, 1 or more. Default: None, no limit.
    """

    n_trials: int = Field(ge=1, description="a whole number of at least 1")
    max_failures: int = Field(default=10, ge=0, description="a whole number of at least 0")
    max_retries: int = Field(default=1, ge=0, description="a whole number of at least 0")
    timeout_hours: float | None = Field(
        default=None, gt=0, allow_inf_nan=False, description="a finite number above 0, or null"
    )
    max_env_steps: int | None = Field(default=None, ge=1, description="a whole number of at least 1, or null")

    def limit_reason(self, state: StudyState) -> str | None:
        """Return which limit, time or environment steps, is reached and stops running trials; None if neither is."""
        if self.timeout_hours is not None and state.busy_hours >= self.timeout_hours:
            return f"study.timeout_hours, {self.timeout_hours:g}, has been reached"
        if self.max_env_steps is not None and state.env_steps >= self.max_env_steps:
            return f"study.max_env_steps, {self.max_env_steps}, has been reached"
        return None

    def failure_reason(self, state: StudyState, failed: Sequence[FrozenTrial]) -> str | None:
        """Return why failed trials end the study; None if they do not."""
        if len(failed) > self.max_failures:
            return f"{len(failed)} trials have failed, and at most {self.max_failures} may: {_reason(failed[-1])}"
        # Final trainings never report, so their environment steps count, too.
        got_nowhere = not state.finished and not any(reports_of(each) or env_steps_of(each) for each in state.all)
        if len(failed) >= FAILURES_BEFORE_REPORTS and got_nowhere:
            return f"the first {len(failed)} trials failed before they reported anything: {_reason(failed[0])}"
        return None


def _reason(trial: FrozenTrial) -> str:
    return f"trial {trial.number}: {trial.user_attrs.get(FAILURE, 'no reason is known')}"

"""State of a study, from its trials in the storage, and the names of their attributes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Self

from optuna.trial import FrozenTrial, TrialState

# User attributes of a trial.
LEASE, ENV_STEPS, METRICS, FAILURE = "lease", "env_steps", "figures", "failure"
RETRIED, RETRY_OF, ATTEMPT, SEEDS = "retried", "retry_of", "attempt", "seeds"
# In the study of final trainings: the trial whose configuration is trained, and the seed.
FINALIST, FINAL_SEED = "judged", "judged_seed"
# What a retry has from the attempt before.
KEPT_BY_RETRY = (SEEDS, FINALIST, FINAL_SEED)
# Of a study: trials whose failures are ignored.
RESET_FAILURES = "forgiven"
# In a lease: the worker that holds the trial.
HOLDER = ("worker", "host", "pid", "started")
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


@dataclass(frozen=True)
class StudyState:
    """State of a study.

    Args:
        finished: trials that ran to their end or were pruned.
        running: trials that workers run.
        waiting: requeued trials, and enqueued retries.
        failed: trials that raised, or whose workers died too often.
        retried: attempts whose worker died, and that were retried.
    """

    finished: tuple[FrozenTrial, ...]
    running: tuple[FrozenTrial, ...]
    waiting: tuple[FrozenTrial, ...]
    failed: tuple[FrozenTrial, ...]
    retried: tuple[FrozenTrial, ...]

    @classmethod
    def of(cls, trials: Sequence[FrozenTrial]) -> Self:
        """Sort trials."""
        ended = [trial for trial in trials if trial.state == TrialState.FAIL]
        return cls(
            finished=tuple(trial for trial in trials if trial.state in FINISHED),
            running=tuple(trial for trial in trials if trial.state == TrialState.RUNNING),
            waiting=tuple(trial for trial in trials if trial.state == TrialState.WAITING),
            failed=tuple(trial for trial in ended if RETRIED not in trial.user_attrs),
            retried=tuple(trial for trial in ended if RETRIED in trial.user_attrs),
        )

    @property
    def all(self) -> tuple[FrozenTrial, ...]:
        """All trials."""
        return self.finished + self.running + self.waiting + self.failed + self.retried

    @property
    def env_steps(self) -> int:
        """Environment steps of all trials; of running ones up to the last heartbeat."""
        # The steps of a dead attempt are counted in its retry.
        return sum(env_steps_of(trial) for trial in self.all if RETRIED not in trial.user_attrs)

    @property
    def busy_hours(self) -> float:
        """Wall time in which at least one trial ran."""
        now, busy_s, until = datetime.now(), 0.0, datetime.min
        spans = [(trial.datetime_start, trial.datetime_complete or now) for trial in self.all if trial.datetime_start]
        for start, end in sorted(spans):
            if end > until:
                busy_s += (end - max(start, until)).total_seconds()
                until = end
        return busy_s / 3600


def env_steps_of(trial: FrozenTrial) -> int:
    """Return the environment steps of a trial, up to its last heartbeat."""
    reported = (trial.user_attrs.get(ENV_STEPS, 0), trial.user_attrs.get(LEASE, {}).get(ENV_STEPS, 0))
    return int(max(reported))

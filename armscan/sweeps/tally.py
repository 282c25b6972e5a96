"""How a study stands, as its trials in the storage say, and what they keep there about themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Self

from optuna.trial import FrozenTrial, TrialState

# User attributes of a trial.
LEASE, ENV_STEPS, FIGURES, FAILURE = "lease", "env_steps", "figures", "failure"
RETRIED, RETRY_OF, ATTEMPT, SEEDS = "retried", "retry_of", "attempt", "seeds"
# Of those, what a retry has from the attempt before: the seeds that are done, and what it is to be judged for.
JUDGED, JUDGED_SEED = "judged", "judged_seed"
KEPT_BY_RETRY = (SEEDS, JUDGED, JUDGED_SEED)
# Of a study: its trials whose failures count no more.
FORGIVEN = "forgiven"
# In a lease: who holds the trial.
HOLDER = ("worker", "host", "pid", "started")
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


@dataclass(frozen=True)
class Tally:
    """How a study stands.

    Args:
        finished: trials that ran to their end or were pruned.
        running: trials that somebody runs.
        waiting: trials that were handed back, or are to be taken up again.
        failed: trials that raised, or whose workers died too often.
        retried: attempts whose worker died, and that another took the place of.
    """

    finished: tuple[FrozenTrial, ...]
    running: tuple[FrozenTrial, ...]
    waiting: tuple[FrozenTrial, ...]
    failed: tuple[FrozenTrial, ...]
    retried: tuple[FrozenTrial, ...]

    @classmethod
    def of(cls, trials: Sequence[FrozenTrial]) -> Self:
        """Sorts trials."""
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
        """Environment steps that all trials have taken; those of running ones as far as was heard."""
        # What a dead attempt has taken is part of the one that takes its place.
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
    """Returns the environment steps that a trial has taken, as far as was heard."""
    told = (trial.user_attrs.get(ENV_STEPS, 0), trial.user_attrs.get(LEASE, {}).get(ENV_STEPS, 0))
    return int(max(told))

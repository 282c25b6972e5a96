"""State of a study: the attributes of its trials, their pending writes, and the study's limits."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Self, TypeVar

import numpy as np
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState
from pydantic import Field

from armscan.sweeps.storage.attribute_names import EARLIER_SPANS, ENV_STEPS, FAILURE, LEASE, RETRIED, TAKEN_FROM
from armscan.sweeps.storage.reports import reports_of
from armscan.utils.arrays import FloatArray
from armscan.utils.section import Section

T = TypeVar("T")
# In place of a trial's number: the control, which is the configuration of the study without the searched values.
CONTROL = -1
# Prefix of the names of metrics on the test volumes.
TEST_PREFIX = "test/"
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
# In a lease: when its worker last renewed it, by the wall clock of its machine, in seconds since 1970.
BEAT_S = "beat_s"
# If this many trials fail before any reports, the configuration is at fault.
FAILURES_AT_ONCE = 3


@dataclass(frozen=True)
class StudyState:
    """State of a study.

    Args:
        finished: Trials that ran to their end or were pruned.
        running: Trials that workers run.
        waiting: Requeued trials and enqueued retries.
        failed: Trials that raised, or whose workers died too often.
        retried: Attempts whose worker died, and that were retried.
        taken: Finished trials taken from other studies, which count towards no limit.
    """

    finished: tuple[FrozenTrial, ...]
    running: tuple[FrozenTrial, ...]
    waiting: tuple[FrozenTrial, ...]
    failed: tuple[FrozenTrial, ...]
    retried: tuple[FrozenTrial, ...]
    taken: tuple[FrozenTrial, ...]

    @classmethod
    def of(cls, trials: Sequence[FrozenTrial]) -> Self:
        """Group trials by their state."""
        taken = [trial for trial in trials if TAKEN_FROM in trial.user_attrs]
        trials = [trial for trial in trials if TAKEN_FROM not in trial.user_attrs]
        ended = [trial for trial in trials if trial.state == TrialState.FAIL]
        return cls(
            finished=tuple(trial for trial in trials if trial.state in FINISHED),
            running=tuple(trial for trial in trials if trial.state == TrialState.RUNNING),
            waiting=tuple(trial for trial in trials if trial.state == TrialState.WAITING),
            failed=tuple(trial for trial in ended if RETRIED not in trial.user_attrs),
            retried=tuple(trial for trial in ended if RETRIED in trial.user_attrs),
            taken=tuple(taken),
        )

    @property
    def all(self) -> tuple[FrozenTrial, ...]:
        """All trials that were run here, or will be."""
        return self.finished + self.running + self.waiting + self.failed + self.retried

    @property
    def n_pruned(self) -> int:
        """Number of finished trials that were pruned."""
        return sum(trial.state == TrialState.PRUNED for trial in self.finished)

    @property
    def env_steps(self) -> int:
        """Environment steps of all trials; of running ones up to the last heartbeat."""
        # The steps of a dead attempt are counted in its retry.
        return sum(env_steps_of(trial) for trial in self.all if RETRIED not in trial.user_attrs)

    @property
    def busy_hours(self) -> float:
        """Wall time in hours during which at least one trial ran."""
        busy_s, until = 0.0, datetime.min
        for start, end in sorted(span for trial in self.all for span in _spans_of(trial)):
            # False within an earlier span, and if the clock was set back meanwhile.
            if end > max(start, until):
                busy_s += (end - max(start, until)).total_seconds()
                until = end
        return busy_s / 3600


def seconds_of(trial: FrozenTrial) -> float | None:
    """Return how long a finished trial ran, with the time before it was requeued; None if it was never run here."""
    if trial.duration is None:
        return None
    return sum((end - start).total_seconds() for start, end in _spans_of(trial))


def _spans_of(trial: FrozenTrial) -> Iterator[tuple[datetime, datetime]]:
    """Yield the start and end of each time that a trial ran, also before it was requeued."""
    for start_s, end_s in trial.user_attrs.get(EARLIER_SPANS, ()):
        yield datetime.fromtimestamp(start_s), datetime.fromtimestamp(end_s)
    if trial.datetime_start:
        yield trial.datetime_start, _last_seen(trial)


def _last_seen(trial: FrozenTrial) -> datetime:
    """Return when a trial ended; for one that has not finished, its worker's last heartbeat."""
    beat_s = trial.user_attrs.get(LEASE, {}).get(BEAT_S)
    if trial.state not in FINISHED and beat_s is not None:
        return datetime.fromtimestamp(beat_s)
    return trial.datetime_complete or datetime.now()


def metrics_of_test(metrics: Mapping[str, float]) -> dict[str, float]:
    """Return a trial's metrics on the test volumes, by their names without the prefix."""
    return {name.removeprefix(TEST_PREFIX): each for name, each in metrics.items() if name.startswith(TEST_PREFIX)}


def loss_signs(directions: Sequence[StudyDirection]) -> FloatArray:
    """Return the factors that turn objectives of these directions into losses: -1 for those to maximise, else 1."""
    return np.where([direction == StudyDirection.MAXIMIZE for direction in directions], -1.0, 1.0)


def env_steps_of(trial: FrozenTrial) -> int:
    """Return the environment steps of a trial, up to its last heartbeat."""
    reported = (trial.user_attrs.get(ENV_STEPS, 0), trial.user_attrs.get(LEASE, {}).get(ENV_STEPS, 0))
    return int(max(reported))


def is_feasible(trial: FrozenTrial) -> bool:
    """Return whether a trial violates no constraint of its study."""
    return all(violation <= 0 for violation in trial.constraints.values())


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
            return f"the {self.timeout_hours:g} hours of study.timeout_hours are over"
        if self.max_env_steps is not None and state.env_steps >= self.max_env_steps:
            return f"the {self.max_env_steps} environment steps of study.max_env_steps are taken"
        return None

    def failure_reason(self, state: StudyState, reset: Collection[int]) -> str | None:
        """Return why failures end the study, ignoring trials with the numbers `reset`; None if they do not."""
        failed = [trial for trial in state.failed if trial.number not in reset]
        if len(failed) > self.max_failures:
            return f"{len(failed)} trials have failed, and at most {self.max_failures} may: {_reason(failed[-1])}"
        # Final trainings never report, so their environment steps count, too.
        got_nowhere = not state.finished and not any(reports_of(each) or env_steps_of(each) for each in state.all)
        if len(failed) >= FAILURES_AT_ONCE and got_nowhere:
            return f"the first {len(failed)} trials failed before they reported anything: {_reason(failed[0])}"
        return None


def _reason(trial: FrozenTrial) -> str:
    return f"trial {trial.number}: {trial.user_attrs.get(FAILURE, 'no reason is known')}"


class PendingWrites(list[Callable[[], object]]):
    """Short writes about a trial, sent with its next report, its outcome or its requeue.

    Each is repeated if the storage became unavailable before it confirmed the write. One thread appends and flushes; a
    requeue may write from another.
    """

    def write(self) -> int:
        """Write all; return how many."""
        writes = self.copy()
        for write in writes:
            write()
        return len(writes)

    def flush_with(self, transaction: Callable[[Callable[[], Any]], Any], operate: Callable[[], T]) -> T:
        """Write all in one transaction with an operation, forget them, and return what the operation returns.

        Args:
            transaction: Function that runs a transaction; see `Storage.transaction`.
            operate: Operation to run, which may be called several times.
        """
        n_written: int
        done: T
        n_written, done = transaction(lambda: (self.write(), operate()))
        del self[:n_written]
        return done


@dataclass(frozen=True)
class PlannedTrial:
    """A trial to enqueue.

    Args:
        params: Its values by parameter name.
        attributes: Its user attributes.
    """

    params: Mapping[str, Any]
    attributes: Mapping[str, Any]


@dataclass(frozen=True)
class ClaimStatus:
    """Whether a trial can be claimed.

    Args:
        end_reason: Why no further trial is claimed; None while trials are missing.
        can_claim: Whether one can be claimed now. Default: False.
        planned: Trials to enqueue before claiming. Default: none.
    """

    end_reason: str | None
    can_claim: bool = False
    planned: Sequence[PlannedTrial] = ()


@dataclass
class TrialOutcome:
    """Outcome of a trial, told to Optuna with the next claim.

    Args:
        trial: Trial that has ended.
        state: State of the trial: COMPLETE, PRUNED or FAIL.
        writes: Pending writes of the trial's attributes.
        values: Values of the objectives, for a complete trial only.
        attributes: User attributes of the trial.
    """

    trial: Trial
    state: TrialState
    writes: PendingWrites
    values: Sequence[float] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    # Stays False if another worker has taken this one for dead, and taken over the trial.
    is_told: bool = field(default=False, init=False)

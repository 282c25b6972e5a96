"""State of a study: its trials by state, and what is known of each."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.sweeps.storage.attribute_names import (
    DROPPED,
    EARLIER_SPANS,
    ENV_STEPS,
    LEASE,
    RETRIED,
    RETRY_OF,
    SEEDS,
    TAKEN_FROM,
)
from armscan.utils.arrays import FloatArray

# In place of a trial's number: the control, which is the configuration of the study without the searched values.
CONTROL = -1
# Prefix of the names of metrics on the test volumes.
TEST_PREFIX = "test/"
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
# In a lease: when its worker last renewed it, by the wall clock of its machine, in seconds since 1970.
BEAT_S = "beat_s"


@dataclass(frozen=True)
class StudyState:
    """State of a study.

    Args:
        finished: Trials that ran to their end or were pruned.
        running: Trials that workers run.
        waiting: Trials that no worker runs yet: requeued ones, retries, and enqueued settings.
        failed: Trials that raised, or whose workers died too often.
        retried: Attempts that count nowhere: their worker died and they were retried, or they were dropped.
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
        busy_s, until_s = 0.0, 0.0
        for start_s, end_s in sorted(span for trial in self.all for span in _spans_of(trial)):
            # False within an earlier span, and if the clock was set back meanwhile.
            if end_s > max(start_s, until_s):
                busy_s += end_s - max(start_s, until_s)
                until_s = end_s
        return busy_s / 3600


def seconds_of(trial: FrozenTrial) -> float | None:
    """Return how long a finished trial ran, with the time before it was requeued; None if it was never run here."""
    if trial.duration is None or TAKEN_FROM in trial.user_attrs:
        return None
    return sum(end_s - start_s for start_s, end_s in _spans_of(trial))


def _spans_of(trial: FrozenTrial) -> Iterator[tuple[float, float]]:
    """Yield the start and end of each time that a trial ran, also before it was requeued, in seconds since 1970."""
    yield from map(tuple, trial.user_attrs.get(EARLIER_SPANS, ()))
    if trial.datetime_start:
        start_s = trial.datetime_start.timestamp()
        # The first heartbeat comes just before.
        yield start_s, max(start_s, _last_seen_s(trial))


def _last_seen_s(trial: FrozenTrial) -> float:
    """Return when a trial ended; for one that has not finished, its worker's last heartbeat."""
    beat_s = trial.user_attrs.get(LEASE, {}).get(BEAT_S)
    if trial.state not in FINISHED and beat_s is not None:
        return float(beat_s)
    return trial.datetime_complete.timestamp() if trial.datetime_complete else time.time()


def metrics_of_test(metrics: Mapping[str, float]) -> dict[str, float]:
    """Return a trial's metrics on the test volumes, by their names without the prefix."""
    return {name.removeprefix(TEST_PREFIX): each for name, each in metrics.items() if name.startswith(TEST_PREFIX)}


def loss_signs(directions: Sequence[StudyDirection]) -> FloatArray:
    """Return the factors that turn objectives of these directions into losses: -1 for those to maximise, else 1."""
    return np.where([direction == StudyDirection.MAXIMIZE for direction in directions], -1.0, 1.0)


def was_retried(trial: FrozenTrial) -> bool:
    """Return whether another trial runs again what this one did not end; a dropped one is not run again."""
    return RETRIED in trial.user_attrs and DROPPED not in trial.user_attrs


def retried_by(trial: FrozenTrial | Trial, trials: Sequence[FrozenTrial]) -> Iterator[int]:
    """Yield the numbers of the attempts that a trial replaces, the latest first."""
    # An untrusted storage may hold any number.
    while (number := trial.user_attrs.get(RETRY_OF)) is not None and number < trial.number:
        yield number
        trial = trials[number]


def env_steps_of(trial: FrozenTrial) -> int:
    """Return the environment steps of a trial, up to its last heartbeat, and at least those of its finished seeds."""
    attributes = trial.user_attrs
    of_seeds = sum(metrics.get(ENV_STEPS, 0) for metrics in attributes.get(SEEDS, {}).values())
    return int(max(attributes.get(ENV_STEPS, 0), attributes.get(LEASE, {}).get(ENV_STEPS, 0), of_seeds))


def is_feasible(trial: FrozenTrial) -> bool:
    """Return whether a trial violates no constraint of its study."""
    return all(violation <= 0 for violation in trial.constraints.values())


def comparable_trials(trials: Iterable[FrozenTrial]) -> list[FrozenTrial]:
    """Return the completed trials that violate no constraint."""
    return [trial for trial in trials if trial.state == TrialState.COMPLETE and is_feasible(trial)]

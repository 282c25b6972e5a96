"""Measure the share of a sweep's worker time that is spent in its trials.

The trials only wait; all other time of the workers is the sweeper's: it samples parameters, starts trials, stores
results, and above all leaves workers idle although trials are left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from optuna.trial import FrozenTrial

from armscan.errors import InvalidValueError
from armscan.sweeps.scheduling.state import StudyState
from armscan.sweeps.storage.attribute_names import METRICS
from benchmarks.sweeps.studies import JOURNAL, N_WORKERS, SLEEPING, by_worker, finish
from benchmarks.sweeps.wait import Waited


@dataclass(frozen=True)
class Occupation:
    """Time of a sweep's workers, from the start of the first trial to the end of the last.

    Args:
        of_worker: Waits of each worker.
    """

    of_worker: Mapping[str, Sequence[Waited]]

    @classmethod
    def of_study(cls, state: StudyState) -> Self:
        """Return the occupation of the workers of a `benchmarks.sweeps.sleeping` study."""
        return cls({worker: list(map(_waited, trials)) for worker, trials in by_worker(state).items()})

    @property
    def waited_s(self) -> float:
        """Sum of the waiting times of all trials, in seconds."""
        return sum(each.length_s for one in self.of_worker.values() for each in one)

    @property
    def begin_s(self) -> float:
        """Time at which the first trial began to wait."""
        return min(each.begin_s for one in self.of_worker.values() for each in one)

    @property
    def ends_s(self) -> list[float]:
        """Time at which the last trial of each worker ended."""
        return [max(each.end_s for each in one) for one in self.of_worker.values()]

    @property
    def wall_s(self) -> float:
        """Seconds from the start of the first trial to the end of the last."""
        return max(self.ends_s) - self.begin_s

    @property
    def share_of_wall(self) -> float:
        """Share of the time of all workers in which trials waited, with the idle time at the end."""
        return self.waited_s / (N_WORKERS * self.wall_s)

    @property
    def share_until_last(self) -> float:
        """The same, but each worker counts only until its own last trial ends: no trial was left after that."""
        return self.waited_s / sum(end_s - self.begin_s for end_s in self.ends_s)


def share_in_trials(state: StudyState) -> float:
    """Return the share of the workers' time that lies between a trial's claim and its tell, by the storage.

    Each worker counts from the start of the study's first trial to the end of its own last one.
    """
    workers = by_worker(state).values()
    begin = min(trials[0].datetime_start for trials in workers)
    inside_s = sum((each.datetime_complete - each.datetime_start).total_seconds() for one in workers for each in one)
    return inside_s / sum((trials[-1].datetime_complete - begin).total_seconds() for trials in workers)


def slept(folder: Path, trials: int, shortest_s: float, longest_s: float) -> StudyState:
    """Run a study of `benchmarks.sweeps.sleeping` in a folder that has none, and return its state."""
    if (folder / JOURNAL).exists():
        raise InvalidValueError(f"{folder} has a study already, whose trials would count, too: give another --folder")
    lengths = (f"+study.task.shortest_s={shortest_s}", f"+study.task.longest_s={longest_s}")
    return finish(folder, *SLEEPING, *lengths, f"study.n_trials={trials}")


def idle(folder: Path, *, trials: int = 60, shortest_s: float = 1.0, longest_s: float = 5.0) -> None:
    """Measure the share of the workers' time spent in trials, and the overhead of each trial."""
    state = slept(folder, trials, shortest_s, longest_s)
    occupation = Occupation.of_study(state)
    beside_s = sorted(
        (trial.datetime_complete - trial.datetime_start).total_seconds() - _waited(trial).length_s
        for trial in state.finished
    )
    print(f"{len(state.finished)} trials by {len(occupation.of_worker)} workers in {occupation.wall_s:.1f} s")
    print(
        f"of the workers' time {share_in_trials(state):.1%} in trials, {occupation.share_until_last:.1%} in what they "
        f"do; {occupation.share_of_wall:.1%} where the end counts for all workers"
    )
    print(
        f"beside what it does a trial takes {beside_s[len(beside_s) // 2]:.2f} s (median), {beside_s[-1]:.2f} s (most)"
    )


def _waited(trial: FrozenTrial) -> Waited:
    return Waited(*(trial.user_attrs[METRICS][name] for name in Waited._fields))

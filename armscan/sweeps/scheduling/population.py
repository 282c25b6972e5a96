"""Population-based training: which member trains next, from which checkpoint, and with which values.

A trial trains one member for one generation, an interval of environment steps, from the last checkpoint of its parent.
Members never wait for each other (asynchronous, as in Jaderberg et al. 2017, arXiv:1711.09846). Everything here is a
function of the trials in the storage and of the study's seed, so a worker's death loses nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from optuna.distributions import BaseDistribution, CategoricalDistribution, IntDistribution
from optuna.samplers import RandomSampler
from optuna.trial import FrozenTrial, Trial, TrialState

from armscan.agents.schedule import FROM
from armscan.sweeps.scheduling.claim import PlannedTrial
from armscan.sweeps.scheduling.state import FINISHED, retried_by
from armscan.sweeps.space.space import Space
from armscan.sweeps.storage.attribute_names import GENERATION, INTERVAL, MEMBER, PARENT, RETRIED, SCHEDULE
from armscan.utils.validation import check_float, check_int

TRAINING_SCHEDULE = "training.schedule"
ACTIVE = (TrialState.RUNNING, TrialState.WAITING)
# A number is multiplied by one of them, as in the paper.
FACTORS = (0.8, 1.2)
Values = dict[str, Any]


class PopulationSampler(RandomSampler):
    """Settings of a population, in the form of an Optuna sampler, which `study/sampler` requires; see `Population`.

    Args:
        population: Number of members, 2 or more.
        interval_env_steps: Environment steps of a generation; divides those of the whole training.
        quantile: Fraction of the members, above 0 and at most 0.5, that counts as worst; each of these continues from
            one of equally many best members. Default: 0.25.
        resample_probability: Probability of resampling a value instead of changing it by a fifth. Default: 0.25.
        seed: Seed that Optuna gives a sampler, without effect: the draws have the study's. Default: None.
    """

    def __init__(
        self,
        population: int,
        interval_env_steps: int,
        quantile: float = 0.25,
        resample_probability: float = 0.25,
        seed: int | None = None,
    ) -> None:
        super().__init__(seed)
        self.population = check_int("study.sampler.population", population, at_least=2)
        self.interval_env_steps = check_int("study.sampler.interval_env_steps", interval_env_steps, at_least=1)
        self.quantile = check_float("study.sampler.quantile", quantile, above=0.0, at_most=0.5)
        self.resample_probability = check_float(
            "study.sampler.resample_probability", resample_probability, at_least=0.0, at_most=1.0
        )


@dataclass(frozen=True)
class Population:
    """The population of a study.

    Args:
        settings: Size and rules.
        space: Keys that are searched.
        total_env_steps: Environment steps of a whole training, a multiple of those of a generation.
        is_maximized: Whether a higher value of the objective is better.
        seed: Seed of the study.
    """

    settings: PopulationSampler
    space: Space
    total_env_steps: int
    is_maximized: bool
    seed: int

    @property
    def n_generations(self) -> int:
        """Number of generations."""
        return self.total_env_steps // self.settings.interval_env_steps

    @property
    def n_trials(self) -> int:
        """Number of trials of the whole study."""
        return self.settings.population * self.n_generations

    def plan(self, trials: Sequence[FrozenTrial]) -> list[PlannedTrial]:
        """Return the next trial; nothing while all members train, and at the end.

        The member that is furthest behind trains next. A member among the worst of its generation so far continues from
        a checkpoint of one of the best, with changed values; so does one whose training has failed or was stopped.

        Args:
            trials: All trials of the study.
        """
        rng = np.random.default_rng(np.random.SeedSequence((self.seed, len(trials))))
        trials = _members(trials)
        ended = {_place(trial): trial for trial in trials if trial.state in FINISHED}
        active = {trial.user_attrs[MEMBER] for trial in trials if trial.state in ACTIVE}
        nexts = {each: sum(member == each for _, member in ended) for each in range(self.settings.population)}
        for generation, member in sorted((generation, member) for member, generation in nexts.items()):
            if generation == self.n_generations or member in active:
                continue
            if generation == 0:
                return [self._planned(member, 0, None, self._drawn(rng), [])]
            has_failed = any(_place(trial) == (generation, member) for trial in trials if _has_failed(trial))
            parent = self._parent(ended[generation - 1, member], trials, rng, has_failed=has_failed)
            if parent is not None:
                is_copy = has_failed or parent.user_attrs[MEMBER] != member
                values = self._explored(parent.params, rng) if is_copy else parent.params
                return [self._planned(member, generation, parent.number, values, parent.user_attrs[SCHEDULE])]
        return []

    def checkpoints_to_keep(self, trials: Sequence[FrozenTrial]) -> set[int]:
        """Return the numbers of the trials from whose last checkpoints a member may still continue.

        A checkpoint of one of the best is kept until all members have finished the next generation, any other only
        until its own member has.

        Args:
            trials: All trials of the study.
        """
        everything, trials = trials, _members(trials)
        active = [trial for trial in trials if trial.state in ACTIVE]
        kept = {trial.number for trial in active}
        # A retry begins from the checkpoint of the attempt before, or from the same parent again.
        kept |= {number for trial in active for number in retried_by(trial, everything)}
        kept |= {trial.user_attrs[PARENT] for trial in active if PARENT in trial.user_attrs}
        n_best = math.ceil(self.settings.quantile * self.settings.population)
        passed = {_place(trial) for trial in trials if trial.state in FINISHED}
        for generation in range(self.n_generations - 1):
            behind = {each for each in range(self.settings.population) if (generation + 1, each) not in passed}
            ranked = self._ranked(trials, generation)
            # Trials that complete this generation later can only lower a trial's rank.
            kept |= {trial.number for trial in ranked[:n_best] if behind}
            kept |= {trial.number for trial in ranked if trial.user_attrs[MEMBER] in behind}
        return kept

    def _ranked(self, trials: Sequence[FrozenTrial], generation: int) -> list[FrozenTrial]:
        """Return the complete trials of a generation, the best first."""
        sign = -1.0 if self.is_maximized else 1.0
        complete = [
            trial
            for trial in trials
            if trial.state == TrialState.COMPLETE and trial.user_attrs[GENERATION] == generation
        ]
        return sorted(complete, key=lambda trial: (sign * trial.values[0], trial.number))

    def _parent(
        self, own: FrozenTrial, trials: Sequence[FrozenTrial], rng: np.random.Generator, *, has_failed: bool
    ) -> FrozenTrial | None:
        """Return the trial that a member continues from: its own, or one of the best; None if there is none yet."""
        ranked = self._ranked(trials, own.user_attrs[GENERATION])
        n_worst = min(math.ceil(self.settings.quantile * len(ranked)), len(ranked) // 2)
        is_worst = own.number in [trial.number for trial in ranked[len(ranked) - n_worst :]]
        if own.state == TrialState.COMPLETE and not is_worst and not has_failed:
            return own
        best = ranked[: max(1, n_worst)]
        return best[int(rng.integers(len(best)))] if best else None

    def _planned(
        self, member: int, generation: int, parent: int | None, values: Values, schedule: Sequence[Values]
    ) -> PlannedTrial:
        start = generation * self.settings.interval_env_steps
        now = {key: value for segment in schedule for key, value in segment.items()}
        changed = {key: value for key, value in values.items() if key not in now or now[key] != value}
        attributes: Values = {
            MEMBER: member,
            GENERATION: generation,
            INTERVAL: [start, start + self.settings.interval_env_steps],
            SCHEDULE: [*schedule, *([{FROM: start, **changed}] if changed else [])],
        }
        return PlannedTrial(values, attributes | ({} if parent is None else {PARENT: parent}))

    def _drawn(self, rng: np.random.Generator) -> Values:
        return {each.name: _draw(each.name, each.distribution, rng) for each in self.space.parameters}

    def _explored(self, values: Mapping[str, Any], rng: np.random.Generator) -> Values:
        """Return values, each changed by a fifth or drawn again."""
        explored = {}
        for each in self.space.parameters:
            if rng.random() < self.settings.resample_probability:
                explored[each.name] = _draw(each.name, each.distribution, rng)
            else:
                explored[each.name] = _perturb(values[each.name], each.distribution, rng)
        return explored


def searched_values(trial: FrozenTrial | Trial) -> Values:
    """Return the values of a trial by key; a member's first values, with later changes as `training.schedule`."""
    schedule = trial.user_attrs.get(SCHEDULE)
    if not schedule:
        return dict(trial.params)
    first, *later = schedule
    values = {key: value for key, value in first.items() if key != FROM}
    return values | ({TRAINING_SCHEDULE: later} if later else {})


def lineage(trials: Sequence[FrozenTrial], last: FrozenTrial) -> Iterator[FrozenTrial]:
    """Yield the ancestors of a trial, the first generation first, then the trial itself."""
    parent = last.user_attrs.get(PARENT)
    if parent is not None:
        yield from lineage(trials, trials[parent])
    yield last


def _members(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """Return the trials of members, without those that were enqueued from elsewhere."""
    return [trial for trial in trials if MEMBER in trial.user_attrs]


def _place(trial: FrozenTrial) -> tuple[int, int]:
    return int(trial.user_attrs[GENERATION]), int(trial.user_attrs[MEMBER])


def _has_failed(trial: FrozenTrial) -> bool:
    return trial.state == TrialState.FAIL and RETRIED not in trial.user_attrs


def _draw(name: str, distribution: BaseDistribution, rng: np.random.Generator) -> Any:
    sampler = RandomSampler(int(rng.integers(2**31)))
    # The sampler uses neither study nor trial.
    return sampler.sample_independent(cast(Any, None), cast(Any, None), name, distribution)


def _perturb(value: Any, distribution: BaseDistribution, rng: np.random.Generator) -> Any:
    """Return a value a fifth higher or lower, within its range; for a choice, one of its neighbours."""
    is_up = bool(rng.integers(2))
    if isinstance(distribution, CategoricalDistribution):
        choices = distribution.choices
        place = choices.index(value)
        beside = [*choices[max(0, place - 1) : place], *choices[place + 1 : place + 2]]
        return beside[is_up % len(beside)] if beside else value
    limits = cast(Any, distribution)
    moved = value * FACTORS[is_up]
    if limits.step:
        n_steps = round((moved - limits.low) / limits.step)
        if n_steps == round((value - limits.low) / limits.step):
            n_steps += 1 if is_up else -1
        moved = limits.low + n_steps * limits.step
    moved = min(max(moved, limits.low), limits.high)
    return int(moved) if isinstance(distribution, IntDistribution) else float(moved)

"""Terminators: rules that end a study before its last trial, because further trials would gain nothing."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from statistics import fmean, variance
from typing import Protocol

import numpy as np
import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial

from armscan.errors import InvalidValueError
from armscan.sweeps.scheduling.state import StudyState, comparable_trials, loss_signs
from armscan.sweeps.storage.attribute_names import SEEDS
from armscan.sweeps.study.pruners import front_numbers
from armscan.utils.validation import check_int

# Share of the trials, the best first, on which the noise between seeds is measured.
BETTER_PART = 0.5


class Terminator(Protocol):
    """Rule that ends a study before its last trial."""

    def check(self, n_objectives: int, n_seeds: int, n_trials: int | None) -> None:
        """Raise `InvalidValueError` if it can never end a study with these numbers.

        Args:
            n_objectives: Number of objectives.
            n_seeds: Number of seeds of a trial.
            n_trials: Number of trials; None if trials of other studies may add to them.
        """

    def reason(self, study: optuna.Study, objectives: Sequence[str], state: StudyState) -> str | None:
        """Return why the study ends; None while it continues."""


class BelowSeedNoise:
    """Ends a study when the regret of its best trial is below the noise between seeds.

    The regret is bounded from above with a Gaussian process (Makarova et al. 2022, arXiv:2104.08166), by Optuna's
    `RegretBoundEvaluator`; the noise is the standard deviation between seeds in the better half of the trials.

    Args:
        min_trials: Completed trials that the study needs before it may end, 2 or more. Default: 20.

    Raises:
        InvalidValueError: If the number is too small.
    """

    def __init__(self, min_trials: int = 20) -> None:
        self._min_trials = check_int("study.terminator.min_trials", min_trials, at_least=2)

    def check(self, n_objectives: int, n_seeds: int, n_trials: int | None) -> None:
        """See `Terminator.check`."""
        _check_enough("min_trials", self._min_trials, n_trials)
        if n_objectives > 1 or n_seeds < 2:
            given = f"{n_objectives} objectives" if n_objectives > 1 else "one seed"
            raise InvalidValueError(
                f"study.terminator compares one objective with the noise between at least two study.seeds, but the "
                f"study has {given}: give study/terminator=stagnation"
            )

    def reason(self, study: optuna.Study, objectives: Sequence[str], state: StudyState) -> str | None:
        """See `Terminator.reason`."""
        trials = comparable_trials((*state.taken, *state.finished))
        if len(trials) < self._min_trials or (noise := seed_noise(trials, objectives[0], study.direction)) is None:
            return None
        # Deferred: it loads torch.
        from optuna.terminator import RegretBoundEvaluator

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            regret = RegretBoundEvaluator(min_n_trials=self._min_trials, seed=0).evaluate(trials, study.direction)
        if regret >= noise:
            return None
        return (
            f"after {len(trials)} trials, further ones may gain at most {regret:.3g} in {objectives[0]}, and the noise "
            f"between seeds is {noise:.3g}"
        )


class Stagnation:
    """Ends a study when its last trials were no better than those before.

    Trials taken from other studies are among those before.

    With several objectives a trial is better if it is on the Pareto front of all trials, and no earlier one is as good.

    Args:
        n_trials: Number of latest completed trials without an improvement, 1 or more. Default: 30.

    Raises:
        InvalidValueError: If the number is too small.
    """

    def __init__(self, n_trials: int = 30) -> None:
        self._n_trials = check_int("study.terminator.n_trials", n_trials, at_least=1)

    def check(self, n_objectives: int, n_seeds: int, n_trials: int | None) -> None:
        """See `Terminator.check`."""
        _check_enough("n_trials", self._n_trials, n_trials)

    def reason(self, study: optuna.Study, objectives: Sequence[str], state: StudyState) -> str | None:
        """See `Terminator.reason`."""
        own = sorted(comparable_trials(state.finished), key=lambda trial: (str(trial.datetime_complete), trial.number))
        trials = [*comparable_trials(state.taken), *own]
        n_before = len(trials) - self._n_trials
        if len(own) < self._n_trials or not n_before:
            return None
        losses = np.array([trial.values for trial in trials]) * loss_signs(study.directions)
        before = np.unique(losses[:n_before], axis=0)
        # Those that are as good as one before are not better.
        new = [loss for loss in losses[n_before:] if not (before <= loss).all(axis=1).any()]
        fronts = front_numbers(np.array([*new, *before]))
        if (fronts[: len(new)] == 0).any():
            return None
        return f"the last {self._n_trials} of {len(trials)} completed trials were no better than those before"


def _check_enough(name: str, value: int, n_trials: int | None) -> None:
    """Raise `InvalidValueError` unless a study has more trials than the terminator needs to end it."""
    if n_trials is not None and value >= n_trials:
        raise InvalidValueError(
            f"study.terminator.{name} is {value}, but it must be less than study.n_trials ({n_trials}), or the study "
            "could not end early"
        )


def seed_noise(trials: Sequence[FrozenTrial], objective: str, direction: StudyDirection) -> float | None:
    """Return the standard deviation of one training between seeds, pooled over the better half of the trials.

    Args:
        trials: Trials that ran to their end.
        objective: Name of the metric.
        direction: Its direction.

    Returns:
        The standard deviation; None if no trial of the better half has two seeds.
    """
    ranked = sorted(trials, key=lambda trial: trial.values[0], reverse=direction == StudyDirection.MAXIMIZE)
    better = ranked[: max(1, round(BETTER_PART * len(ranked)))]
    of_trials = [[each[objective] for each in trial.user_attrs.get(SEEDS, {}).values()] for trial in better]
    variances = [variance(values) for values in of_trials if len(values) > 1]
    return fmean(variances) ** 0.5 if variances else None

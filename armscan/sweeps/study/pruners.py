"""Pruners that compare trials at rungs: of one objective, and of several, which Optuna's own refuse."""

from __future__ import annotations

from collections.abc import Container
from typing import Any, cast

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.pruners import BasePruner, SuccessiveHalvingPruner
from optuna.trial import FrozenTrial, TrialState

from armscan.sweeps.scheduling.state import loss_signs
from armscan.sweeps.storage.attribute_names import RETRIED
from armscan.sweeps.storage.reports import reports_of
from armscan.utils.validation import check_int

Losses = NDArray[np.float64]


class HalvingPruner(SuccessiveHalvingPruner):
    """Optuna's asynchronous successive halving, which counts a trial once, however often it was retried."""

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """Return whether to prune a trial; see `SuccessiveHalvingPruner.prune`."""
        return super().prune(cast(optuna.Study, _WithoutRetried(study)), trial)


class ParetoPruner(BasePruner):
    """Asynchronous successive halving by Pareto fronts.

    The first rung is at `min_resource` steps, and each further one at `reduction_factor` times as many. A trial that
    reaches a rung is compared with all trials that have reached it, and with the final values of those that completed
    before it. One trial in `reduction_factor` may continue, at least one: a trial is pruned if that many are better.
    Trials are ranked by Pareto front, and within a front by crowding distance, the larger the better (Schmucker et al.
    2021, arXiv:2106.12639; Deb et al. 2002, doi:10.1109/4235.996017). The whole first front always continues.

    Args:
        min_resource: Environment steps of the first rung, 1 or more.
        reduction_factor: Reduction factor, 2 or more: one trial in so many continues from a rung. Default: 3.

    Raises:
        InvalidValueError: If a number is too small.
    """

    def __init__(self, min_resource: int, reduction_factor: int = 3) -> None:
        self._min_resource = check_int("study.pruner.min_resource", min_resource, at_least=1)
        self._reduction_factor = check_int("study.pruner.reduction_factor", reduction_factor, at_least=2)

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """Return whether to prune a trial, which is possible only at its first report on a rung."""
        steps = list(reports_of(trial))
        rung = self._rung_below(steps[-1]) if steps else None
        if rung is None or any(step >= rung for step in steps[:-1]):
            return False
        others = [each for each in _WithoutRetried(study).get_trials() if each.number != trial.number]
        reached = [_values_at(rung, each) for each in others]
        values = [_values_at(rung, trial), *filter(None, reached)]
        losses = np.array(values, dtype=float) * loss_signs(study.directions)
        # An unknown value counts as worst.
        losses = np.nan_to_num(losses, nan=np.inf, posinf=np.inf, neginf=-np.inf)
        return bool(n_better(losses) >= max(1, len(losses) // self._reduction_factor))

    def _rung_below(self, step: int) -> int | None:
        """Return the highest rung that is not above a step; None below the first."""
        if step < self._min_resource:
            return None
        rung = self._min_resource
        while (following := rung * self._reduction_factor) <= step:
            rung = following
        return rung


class _WithoutRetried:
    """A study without the trials that were retried: their retries have their reports."""

    def __init__(self, study: optuna.Study) -> None:
        self._study = study

    def __getattr__(self, name: str) -> Any:
        return getattr(self._study, name)

    def get_trials(self, deepcopy: bool = False, states: Container[TrialState] | None = None) -> list[FrozenTrial]:
        """Return the trials that count."""
        return [each for each in self._study.get_trials(deepcopy, states) if RETRIED not in each.user_attrs]


def _values_at(rung: int, trial: FrozenTrial) -> tuple[float, ...] | None:
    """Return the values of a trial at a rung, or its final ones if it completed before it; None if it has neither."""
    at_rung = next((values for step, values in reports_of(trial).items() if step >= rung), None)
    if at_rung is None and trial.state == TrialState.COMPLETE:
        return tuple(trial.values)
    return at_rung


def n_better(losses: Losses) -> int:
    """Return how many trials are better than the first one: 0 if it is on the first front.

    Args:
        losses: Losses, shape (trials, objectives); lower is better.
    """
    fronts = front_numbers(losses)
    beside = np.flatnonzero(fronts == fronts[0])
    if fronts[0] == 0:
        return 0
    distances = crowding_distances(losses[beside])
    return int(np.sum(fronts < fronts[0]) + np.sum(distances > distances[0]))


def front_numbers(losses: Losses) -> NDArray[np.int64]:
    """Return the number of the Pareto front of each trial, from 0, of losses of shape (trials, objectives)."""
    numbers = np.full(len(losses), -1)
    # dominates[i, j]: trial i is nowhere worse than trial j, and better in one objective.
    no_worse = np.asarray((losses[:, None] <= losses[None]).all(axis=2))
    dominates = no_worse & ~no_worse.T
    front = 0
    while (left := numbers < 0).any():
        numbers[left & ~dominates[left].any(axis=0)] = front
        front += 1
    return numbers


def crowding_distances(losses: Losses) -> Losses:
    """Return the crowding distance of each trial of one front: how far its neighbours are, over all objectives.

    Args:
        losses: Losses, shape (trials, objectives).

    Returns:
        Distances of shape (trials,); infinite for the first best and the last worst of an objective
        that varies.
    """
    distances = np.zeros(len(losses))
    for values in losses.T:
        order = np.argsort(values, kind="stable")
        ordered = values[order]
        # An objective that is constant, or unknown for some trial, adds nothing.
        if np.isfinite(ordered[[0, -1]]).all() and ordered[0] < ordered[-1]:
            inner = (ordered[2:] - ordered[:-2]) / (ordered[-1] - ordered[0])
            distances[order] += np.concatenate([[np.inf], inner, [np.inf]])
    return distances

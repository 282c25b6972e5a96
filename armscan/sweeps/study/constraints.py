"""Constraints of a study: bounds that the metrics of its trials must keep."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

from optuna.trial import Trial

from armscan.errors import InvalidValueError
from armscan.sweeps.tasks.attempt import Attempt

Run = Callable[[Attempt], dict[str, float]]
CONSTRAINT = re.compile(r"\s*(\S+?)\s*(<=|>=)\s*(\S+)\s*")


@dataclass(frozen=True)
class Constraint:
    """A bound that a metric must keep.

    Args:
        metric: Name of the metric.
        is_upper: Whether the bound is the largest allowed value, instead of the smallest.
        bound: The bound, which is itself allowed.
    """

    metric: str
    is_upper: bool
    bound: float

    @classmethod
    def read(cls, text: Any) -> Self:
        """Return the constraint of a string such as `training_s <= 60`.

        Raises:
            InvalidValueError: If the text is not a constraint.
        """
        found = CONSTRAINT.fullmatch(text) if isinstance(text, str) else None
        try:
            bound = float(found[3]) if found else math.nan
        except ValueError:
            bound = math.nan
        if found is None or not math.isfinite(bound):
            raise InvalidValueError(
                f"study.constraints has {text!r}, but each must be a metric, <= or >=, and a finite number, such as "
                "'training_s <= 60'"
            )
        return cls(found[1], found[2] == "<=", bound)

    def __str__(self) -> str:
        bound = f"{self.bound:g}"
        return f"{self.metric} {'<=' if self.is_upper else '>='} {bound if float(bound) == self.bound else self.bound}"

    def violation(self, metrics: Mapping[str, float]) -> float:
        """Return by how much metrics violate it, relative to the bound: at most 0 if they do not.

        Relative, because Optuna's samplers add up the violations of all constraints. A metric that is missing or NaN
        violates it infinitely.
        """
        value = metrics.get(self.metric, math.nan)
        if math.isnan(value):
            return math.inf
        beyond = value - self.bound if self.is_upper else self.bound - value
        return beyond / (abs(self.bound) or 1.0)


def constrained(run: Run, constraints: Sequence[Constraint]) -> Run:
    """Return a function that runs a trial and tells Optuna by how much its metrics violate each constraint.

    Args:
        run: Function that runs an attempt at a trial and returns its metrics.
        constraints: Constraints of the study.
    """

    def run_constrained(attempt: Attempt) -> dict[str, float]:
        metrics = run(attempt)
        violations = {str(constraint): constraint.violation(metrics) for constraint in constraints}
        attempt.writes.append(partial(_keep, attempt.trial, violations))
        return metrics

    return run_constrained if constraints else run


def _keep(trial: Trial, violations: Mapping[str, float]) -> None:
    # A new object: writes that the trial has cached may have been lost with the connection.
    again = Trial(trial.study, trial._trial_id)
    stored = again.constraints
    for name, violation in violations.items():
        if name not in stored:
            again.set_constraint(name, violation)

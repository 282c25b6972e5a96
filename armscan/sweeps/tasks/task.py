"""Tasks of trials, and the metrics that they return."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, Protocol

from omegaconf import DictConfig

from armscan.errors import InvalidValueError, listed
from armscan.sweeps.tasks.attempt import Attempt
from armscan.utils.validation import check_float


class Task(Protocol):
    """Work of the trials of a study; `study.task._target_` names its class, which needs no arguments."""

    def metrics(self, config: DictConfig) -> tuple[str, ...]:
        """Return the names of the metrics that `run` returns in this configuration, which may be objectives."""

    @property
    def final_metric(self) -> str:
        """Name of the leading metric that `evaluate` returns."""

    def check(self, config: DictConfig) -> None:
        """Check that a trial with this configuration could begin; called for many of them before the first trial.

        Raises:
            ArmscanError: If it could not.
        """

    def run(self, attempt: Attempt) -> dict[str, float]:
        """Run a trial, or resume one, and return its metrics.

        Trials are compared by these metrics, so they should not be the best of several validations.

        Raises:
            optuna.TrialPruned: If the trial is pruned.
        """

    def validate(self, attempt: Attempt) -> dict[str, float]:
        """Run a candidate with one seed, and return the metrics that `run` returns, on the validation volumes.

        Candidates are compared by these metrics, so they must not be the best of several validations. The configuration
        has `study.final_eval.episodes` as its `evaluation.episodes`, as that of `evaluate`.
        """

    def evaluate(self, attempt: Attempt) -> dict[str, float]:
        """Run the chosen configuration, or the control, with one other seed, and return metrics on the test volumes.

        Their names begin with `test/`.
        """


def check_metrics(metrics: Any, objectives: Sequence[str]) -> dict[str, float]:
    """Return the metrics of a task by name, checked: objectives must be finite."""
    if not isinstance(metrics, Mapping):
        raise InvalidValueError(f"the task has returned {metrics!r}, but it must be metrics by their names")
    if missing := [name for name in objectives if name not in metrics]:
        raise InvalidValueError(f"the task has not returned {missing[0]}, but only {listed(list(metrics))}")
    for name, value in metrics.items():
        if name in objectives:
            check_float(f"what the task has returned as {name}", value)
        elif not isinstance(value, Real):
            raise InvalidValueError(f"what the task has returned as {name} is {value!r}, but it must be a number")
    return {str(name): float(value) for name, value in metrics.items()}

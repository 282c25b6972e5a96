"""What a trial can be: whoever has these methods can be swept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any, Protocol

from hydra.utils import instantiate
from omegaconf import DictConfig

from armscan.config.defaults import to_plain
from armscan.errors import InvalidValueError, listed
from armscan.training import Split
from armscan.utils.validation import check_float

if TYPE_CHECKING:
    from armscan.sweeps.tasks.attempt import Attempt


class Task(Protocol):
    """What the trials of a study do; `study.task._target_` names its class, which needs no arguments."""

    @property
    def metrics(self) -> tuple[str, ...]:
        """The names of the metrics that `run` returns, which a study may have as objectives."""

    @property
    def final_metric(self) -> str:
        """Of the metrics that `evaluate` returns, the name of the one that says most."""

    def check(self, config: DictConfig) -> None:
        """Check that a trial with this configuration could begin; called for many before the first trial.

        Raises:
            ArmscanError: if it could not.
        """

    def run(self, attempt: Attempt) -> dict[str, float]:
        """Run a trial, or resume one, and return its metrics.

        Raises:
            optuna.TrialPruned: if the trial is not worth going on with.
        """

    def evaluate(self, attempt: Attempt) -> dict[str, float]:
        """Run one of the best configurations with a seed that did not choose it, and returns the metrics of the test.

        Their names begin with `test/`.
        """


class VolumesInMemory:
    """The volumes of one configuration after the other, read anew only where they are others."""

    def __init__(self) -> None:
        self._data: str | None = None

    def of(self, config: DictConfig) -> Split:
        """Return the volumes of a configuration."""
        data = str(to_plain(config.data))
        if self._data != data:
            self._split: Split = instantiate(config.data, _convert_="object")
            self._data = data
        return self._split


def check_metrics(metrics: Any, objectives: Sequence[str]) -> dict[str, float]:
    """Return what a task has returned.

    Args:
        metrics: by name; those that are no objectives may be NaN.
        objectives: the names of those that must be there, and finite.

    Raises:
        InvalidValueError: if it is anything else.
    """
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

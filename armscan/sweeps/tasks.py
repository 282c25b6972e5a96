"""What a trial can be: whoever has these methods can be swept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from hydra.utils import instantiate
from omegaconf import DictConfig

from armscan.settings import plain
from armscan.training import Split

if TYPE_CHECKING:
    from armscan.sweeps.attempt import Attempt


class Task(Protocol):
    """What the trials of a study do; `study.task._target_` names its class, which needs no arguments."""

    @property
    def figures(self) -> tuple[str, ...]:
        """The names of the figures that `run` returns, which a study may have as objectives."""

    @property
    def judged(self) -> str:
        """Of the figures that `judge` returns, the name of the one that says most."""

    def check(self, config: DictConfig) -> None:
        """Checks that a trial with this configuration could begin; called for many before the first trial.

        Raises:
            ArmscanError: if it could not.
        """

    def run(self, attempt: Attempt) -> dict[str, float]:
        """Runs a trial, or goes on with one, and returns its figures.

        Raises:
            optuna.TrialPruned: if the trial is not worth going on with.
        """

    def judge(self, attempt: Attempt) -> dict[str, float]:
        """Runs one of the best configurations with a seed that did not choose it, and returns the figures of the test.

        Their names begin with `test/`.
        """


class VolumesInMemory:
    """The volumes of one configuration after the other, read anew only where they are others."""

    def __init__(self) -> None:
        self._data: str | None = None

    def of(self, config: DictConfig) -> Split:
        """Returns the volumes of a configuration."""
        data = str(plain(config.data))
        if self._data != data:
            self._split: Split = instantiate(config.data, _convert_="object")
            self._data = data
        return self._split

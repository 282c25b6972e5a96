"""Storages that check the data of studies on each read: others may write to them at any time."""

from __future__ import annotations

import contextlib
from collections.abc import Container, Iterator
from typing import Any

from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState

from armscan.errors import ArmscanError, StudyError
from armscan.sweeps.storage.attribute_names import OF_STUDY
from armscan.sweeps.storage.attributes import (
    DAMAGED,
    UNREADABLE,
    StudyAttributes,
    TrialAttributes,
    check_trial,
    unreadable,
)


class CheckedReads(BaseStorage):
    """Base class, listed before one of Optuna's storages, that checks what that storage reads."""

    # False for Optuna's dashboard, which shows attributes of any type.
    checks_reads = True

    def __init__(self, *arguments: Any) -> None:
        # IDs of finished trials that were found sound: nobody can change them through Optuna.
        self._sound: set[int] = set()
        super().__init__(*arguments)

    @property
    def _stored(self) -> Any:
        """Optuna's storage, which reads without checks."""
        return super()

    def get_all_trials(
        self, study_id: int, deepcopy: bool = True, states: Container[TrialState] | None = None
    ) -> list[FrozenTrial]:
        """Return the trials of a study, checked as by `check_trials`."""
        if not self.checks_reads:
            trials: list[FrozenTrial] = self._stored.get_all_trials(study_id, deepcopy, states)
            return trials
        try:
            name = self.get_study_name_from_id(study_id)
        except KeyError as error:
            raise StudyError("the study was deleted from its storage while it ran") from error
        with _in_one_line(f"study {name!r}"):
            trials = self._stored.get_all_trials(study_id, deepcopy, states)
        unknown = [trial for trial in trials if trial._trial_id not in self._sound]
        n_objectives = len(self.get_study_directions(study_id)) if unknown else 0
        for trial in unknown:
            check_trial(trial, name, n_objectives)
        self._sound.update(trial._trial_id for trial in unknown if trial.state.is_finished())
        return trials

    def get_trial(self, trial_id: int) -> FrozenTrial:
        """Return a trial, with its attributes checked."""
        # Not a `KeyError`, by which Optuna says that there is no such trial.
        with _in_one_line("a study", DAMAGED):
            trial: FrozenTrial = self._stored.get_trial(trial_id)
        if self.checks_reads:
            TrialAttributes.read(f"trials[{trial.number}].user_attrs", trial.user_attrs)
        return trial

    def get_study_user_attrs(self, study_id: int) -> dict[str, Any]:
        """Return the user attributes of a study, checked if armscan has written them."""
        with _in_one_line("a study"):
            attributes: dict[str, Any] = self._stored.get_study_user_attrs(study_id)
        if self.checks_reads and attributes.keys() >= OF_STUDY:
            StudyAttributes.read("study.user_attrs", attributes)
        return attributes


@contextlib.contextmanager
def _in_one_line(what: str, errors: tuple[type[Exception], ...] = UNREADABLE) -> Iterator[None]:
    try:
        yield
    except errors as error:
        if isinstance(error, ArmscanError):
            raise
        raise unreadable(what, error) from error

"""The end of a study before its last trial: decided once, stored, and the same for every worker."""

from __future__ import annotations

from collections.abc import Callable

import optuna

from armscan.sweeps.scheduling.state import StudyState
from armscan.sweeps.storage.attribute_names import TERMINATED
from armscan.sweeps.storage.storage import Storage

# Keys of the attribute of a study that has ended; of one that was reopened since, the number of its finished trials.
REASON, ASKED, N_FINISHED = "reason", "asked", "n_finished"


class Termination:
    """Decision to end a study before its last trial.

    Args:
        study: The study in its storage.
        storage: The storage.
        find_reason: Function that returns why a study ends, None if it continues. It may take seconds.
        asked: Requested number of trials and terminator, as a string; an ended study continues if it changes.
    """

    def __init__(
        self, study: optuna.Study, storage: Storage, find_reason: Callable[[StudyState], str | None], asked: str
    ) -> None:
        self._study, self._storage = study, storage
        self._find_reason, self._asked = find_reason, asked
        # Finished trials at the last check: nothing new can be found without another.
        self._n_seen = -1

    @property
    def reason(self) -> str | None:
        """Reason why the study has ended; None while it continues."""
        return ended_because(self._study, self._asked)

    def check(self, state: StudyState) -> None:
        """Check whether the study ends, once for each number of finished trials, without holding the lock."""
        n_seen = len(state.finished)
        if n_seen == self._n_seen:
            return
        self._n_seen = n_seen
        # The rule that ended a study is still fulfilled when that is reopened.
        is_new = n_seen > self._study.user_attrs.get(TERMINATED, {}).get(N_FINISHED, -1)
        if is_new and self.reason is None and (reason := self._find_reason(state)) is not None:
            self._storage.exclusive(lambda: self._keep(reason))

    def _keep(self, reason: str) -> None:
        # Another worker may have found it, too: the first counts.
        if self.reason is None:
            self._study.set_user_attr(TERMINATED, {REASON: reason, ASKED: self._asked})


def reopen(study: optuna.Study, storage: Storage, asked: str) -> bool:
    """Reopen a study that has ended before its last trial, if something else is asked for; return whether it was.

    Args:
        study: The study in its storage.
        storage: The storage.
        asked: See `Termination`.
    """

    def reopened() -> bool:
        ended = study.user_attrs.get(TERMINATED, {})
        if REASON not in ended or ended.get(ASKED) == asked:
            return False
        finished = StudyState.of(study.get_trials(deepcopy=False)).finished
        study.set_user_attr(TERMINATED, {N_FINISHED: len(finished)})
        return True

    return storage.exclusive(reopened)


def ended_because(study: optuna.Study, asked: str) -> str | None:
    """Return why a study has ended before its last trial, None if it has not.

    Args:
        study: The study in its storage.
        asked: See `Termination`.
    """
    kept = study.user_attrs.get(TERMINATED, {})
    return kept[REASON] if kept.get(ASKED) == asked and REASON in kept else None

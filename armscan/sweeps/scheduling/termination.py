"""The end of a study before its last trial: decided once, stored, and the same for every worker."""

from __future__ import annotations

from collections.abc import Callable

import optuna

from armscan.sweeps.scheduling.state import StudyState
from armscan.sweeps.storage.attribute_names import TERMINATED
from armscan.sweeps.storage.storage import Storage

# Keys of the attribute of a study that has ended.
REASON, ASKED = "reason", "asked"


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
        if self.reason is None and (reason := self._find_reason(state)) is not None:
            self._storage.exclusive(lambda: self._keep(reason))

    def _keep(self, reason: str) -> None:
        # Another worker may have found it, too: the first counts.
        if self.reason is None:
            self._study.set_user_attr(TERMINATED, {REASON: reason, ASKED: self._asked})


def ended_because(study: optuna.Study, asked: str) -> str | None:
    """Return why a study has ended before its last trial, None if it has not.

    Args:
        study: The study in its storage.
        asked: See `Termination`.
    """
    kept = study.user_attrs.get(TERMINATED, {})
    return kept[REASON] if kept.get(ASKED) == asked and REASON in kept else None

"""Notes on what the trials of a study do not have in common."""

from __future__ import annotations

from collections import Counter

import optuna

from armscan.sweeps.scheduling.state import FINISHED
from armscan.sweeps.storage.attribute_names import CODE, LEASE
from armscan.sweeps.study.fixed_config import change_notes


def notes_on(study: optuna.Study) -> list[str]:
    """Return a note on each change of a study's configuration, and on different versions of armscan's code."""
    return [*change_notes(study), *code_notes(study, "its trials")]


def code_notes(study: optuna.Study, what: str) -> list[str]:
    """Return a note if different versions of armscan's code ran the finished trials of a study.

    Args:
        study: A study, or the selection or test of one.
        what: The trials, as the note calls them.
    """
    leases = (trial.user_attrs.get(LEASE, {}) for trial in study.get_trials(deepcopy=False, states=FINISHED))
    # Earlier versions, and trials of other studies, tell nothing.
    known = Counter(lease[CODE] for lease in leases if lease.get(CODE))
    if len({code.rpartition(" ")[2] for code in known}) < 2:
        return []
    counts = ", ".join(f"{code}: {n_trials}" for code, n_trials in known.items())
    versions = f"different versions of armscan's code (commit, checksum: trials; {counts})"
    return [f"{what} had {versions}; their values may differ"]

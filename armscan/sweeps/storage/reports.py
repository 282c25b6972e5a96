"""Reports of a trial while it runs: the values of the objectives at its steps."""

from __future__ import annotations

from collections.abc import Sequence

from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial

# Begins the names of the system attributes that hold the reports of several objectives; the step follows.
REPORT = "report:"


def keep_report(storage: BaseStorage, trial_id: int, step: int, values: Sequence[float]) -> None:
    """Keep a report in the storage.

    One value is kept as Optuna keeps it. Optuna keeps no reports of several objectives, and its samplers refuse
    intermediate values in such a study: these reports are system attributes.

    Args:
        storage: Storage of the study.
        trial_id: ID of the running trial in the storage.
        step: Step of the trial.
        values: Value of each objective.
    """
    if len(values) == 1:
        storage.set_trial_intermediate_value(trial_id, step, values[0])
    else:
        storage.set_trial_system_attr(trial_id, f"{REPORT}{step}", list(values))


def reports_of(trial: FrozenTrial) -> dict[int, tuple[float, ...]]:
    """Return the values of the objectives by the steps at which a trial has reported them, in the order of steps."""
    reports = {step: (value,) for step, value in trial.intermediate_values.items()}
    for name, values in trial.system_attrs.items():
        if name.startswith(REPORT):
            reports[int(name.removeprefix(REPORT))] = tuple(values)
    return dict(sorted(reports.items()))

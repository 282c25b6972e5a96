"""Reports of a trial while it runs: the values of the objectives at its steps."""

from __future__ import annotations

from collections.abc import Sequence

from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial

# Prefix of the system attributes that hold the reports of several objectives; the step follows.
REPORT = "report:"


def store_report(storage: BaseStorage, trial_id: int, step: int, values: Sequence[float]) -> None:
    """Store a report.

    A single value is stored as Optuna's intermediate value. Optuna supports no reports of several objectives, and its
    samplers refuse intermediate values in such a study, so these reports are system attributes.

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
    """Return a trial's reports: the values of the objectives by step, in the order of steps."""
    reports = {step: (value,) for step, value in trial.intermediate_values.items()}
    for name, values in trial.system_attrs.items():
        if name.startswith(REPORT):
            reports[int(name.removeprefix(REPORT))] = tuple(values)
    return dict(sorted(reports.items()))

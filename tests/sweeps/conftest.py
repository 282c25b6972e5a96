"""Storages of every kind, and studies in them that train nothing."""

import optuna
import pytest
from optuna.trial import TrialState

from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import Limits, PendingWrites, TrialOutcome
from armscan.sweeps.storage.attribute_names import FAILURE
from armscan.sweeps.storage.storage import open_storage


@pytest.fixture(params=["journal", *(pytest.param(each, marks=pytest.mark.full) for each in ("sqlite", "postgresql"))])
def storage_uri(request, tmp_path):
    match request.param:
        case "journal":
            return str(tmp_path / "a.journal")
        case "sqlite":
            return f"sqlite:///{tmp_path}/a.db"
        case _:
            return request.getfixturevalue("postgres").make_database()


@pytest.fixture
def make_scheduler(storage_uri):
    """Open the same study again and again, as workers do."""

    def make(**limits):
        storage = open_storage(storage_uri)
        study = optuna.create_study(study_name="a", storage=storage.optuna, load_if_exists=True)
        plan = limits.pop("plan", None)
        return TrialScheduler(study, storage, Limits(**{"n_trials": 5} | limits), plan)

    return make


def fail(scheduler, trial, reason):
    """End a trial as failed, as its worker does with its next claim."""
    outcome = TrialOutcome(trial, TrialState.FAIL, PendingWrites(), attributes={FAILURE: reason})
    scheduler.storage.exclusive(lambda: scheduler._tell(outcome, is_repeated=False))
    assert outcome.is_told

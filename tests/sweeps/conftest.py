"""Storages of every kind, and studies in them that train nothing."""

import optuna
import pytest
from optuna.trial import TrialState

from armscan.sweeps.ledger import Ledger
from armscan.sweeps.limits import Limits
from armscan.sweeps.outcome import Notes, Outcome
from armscan.sweeps.storage import open_storage
from armscan.sweeps.tally import FAILURE


@pytest.fixture(params=["journal", "sqlite", "postgresql"])
def storage_uri(request, tmp_path):
    match request.param:
        case "journal":
            return str(tmp_path / "a.journal")
        case "sqlite":
            return f"sqlite:///{tmp_path}/a.db"
        case _:
            return request.getfixturevalue("postgres").make_database()


@pytest.fixture
def make_ledger(storage_uri):
    """Opens the same study again and again, as workers do."""

    def make(**limits):
        storage = open_storage(storage_uri)
        study = optuna.create_study(study_name="a", storage=storage.optuna, load_if_exists=True)
        is_open = limits.pop("is_open", True)
        return Ledger(study, storage, Limits(**{"n_trials": 5} | limits), is_open=is_open)

    return make


def fail(ledger, trial, reason):
    """Ends a trial as failed, as its worker does with its next claim."""
    outcome = Outcome(trial, TrialState.FAIL, Notes(), attributes={FAILURE: reason})
    ledger._storage.alone(lambda: ledger._tell(outcome, is_repeated=False))
    assert outcome.is_told

"""Storages of every kind, and studies in them that train nothing."""

import shutil
from functools import partial
from types import SimpleNamespace

import optuna
import pytest
from omegaconf import OmegaConf
from optuna.trial import TrialState

from armscan.sweeps.scheduling.claim import PendingWrites, TrialOutcome
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.storage.attribute_names import FAILURE
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.open import open_for_work
from armscan.tracking import open_store
from tests.sweeps.study.test_study import settings

TASK = SimpleNamespace(run=None, validate=None, evaluate=None, final_metric="test/mean_steps")


@pytest.fixture(params=["journal", *(pytest.param(each, marks=pytest.mark.full) for each in ("sqlite", "postgresql"))])
def storage_uri(request, tmp_path):
    match request.param:
        case "journal":
            return str(tmp_path / "a.journal")
        case "sqlite":
            return f"sqlite:///{tmp_path}/a.db"
        case _:
            return request.getfixturevalue("postgres").make_database()


def scheduler_at(uri, *, plan=None, **limits):
    """Open the study of a storage, as workers do."""
    storage = open_storage(uri)
    study = optuna.create_study(study_name="a", storage=storage.optuna, load_if_exists=True)
    return TrialScheduler(study, storage, Limits(**{"n_trials": 5} | limits), plan)


@pytest.fixture
def make_scheduler(storage_uri):
    """Open the same study again and again."""
    return partial(scheduler_at, storage_uri)


@pytest.fixture
def opened(tmp_path, empty_database, monkeypatch):
    """Return a function that opens a study by storage and name; all are tracked in one store."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(empty_database, tmp_path / "runs.db")
    tracking = {"uri": "sqlite:///runs.db", "experiment": "a", "artifacts": "artifacts", "wait_s": 60.0}

    def open_study(
        storage="optuna.journal", name="a", overrides=("sweep=sac_y",), volumes=None, is_worker=False, **changes
    ):
        asked = settings(name=name, storage=storage, folder=f"studies/{name}", **changes)
        config = OmegaConf.create({"tracking": tracking})
        return open_for_work(asked, TASK, config, overrides, volumes=volumes, is_worker=is_worker)

    open_study.store = open_store(**tracking)
    return open_study


def fail(scheduler, trial, reason):
    """End a trial as failed, as its worker does with its next claim."""
    outcome = TrialOutcome(trial, TrialState.FAIL, PendingWrites(), attributes={FAILURE: reason})
    scheduler.storage.exclusive(lambda: scheduler._tell(outcome, is_repeated=False))
    assert outcome.is_told

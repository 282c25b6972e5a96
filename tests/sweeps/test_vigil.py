"""A study that is watched from afar: when it is over, and whether anybody is at work."""

import threading
import time
from types import SimpleNamespace

import optuna
import pytest
from optuna.trial import TrialState

from armscan.sweeps import vigil as module
from armscan.sweeps.judging import lacking
from armscan.sweeps.ledger import Ledger
from armscan.sweeps.limits import Limits
from armscan.sweeps.storage import open_storage
from armscan.sweeps.tally import JUDGED, JUDGED_SEED
from armscan.sweeps.vigil import Vigil

ELSEWHERE = {"worker": "0", "host": "elsewhere", "pid": 1, "started": "1"}


@pytest.fixture
def storage_uri(tmp_path):
    """It is the same in every storage."""
    return str(tmp_path / "a.journal")


@pytest.fixture
def watch(make_ledger, monkeypatch):
    """Watches a study of two trials, in which one is running; returns the watcher, the ledger and that trial."""
    for name, value in (("LOOK_S", 0.05), ("OVER_S", 0.2), ("LIFELESS_S", 1.5)):
        monkeypatch.setattr(module, name, value)

    def watch(best=0):
        ledger = make_ledger(n_trials=2)
        phases = [SimpleNamespace(name="a", ledger=ledger)]
        settings = SimpleNamespace(judging=SimpleNamespace(best=best, seeds=1), seeds=(0,))
        first, second = ledger.claim(ELSEWHERE), ledger.claim(ELSEWHERE)
        ledger.study.tell(first, 1.0)
        watch.phases, watch.settings = phases, settings
        return Vigil(SimpleNamespace(begun=lambda: phases, settings=settings)), ledger, second

    return watch


def test_study_is_over_when_enough_trials_have_finished_and_none_is_running(watch):
    vigil, ledger, running = watch()
    assert not vigil.is_over()
    ledger.study.tell(running, 1.0)
    assert vigil.is_over()


def test_study_that_is_to_be_judged_is_over_when_its_best_has_been(watch, storage_uri):
    vigil, ledger, running = watch(best=1)
    ledger.study.tell(running, 1.0)
    assert not vigil.is_over()
    storage = open_storage(storage_uri)
    made = optuna.create_study(study_name="a-judged", storage=storage.optuna)
    watch.phases.append(
        SimpleNamespace(name="a-judged", ledger=Ledger(made, storage, Limits(n_trials=9), is_open=False))
    )
    # As it is where others were judged before.
    assert not vigil.is_over()
    ((best, seed),) = lacking(watch.settings, ledger.study, made)
    made.enqueue_trial({}, user_attrs={JUDGED: best.number, JUDGED_SEED: seed})
    assert not vigil.is_over()
    made.tell(made.ask(), 1.0)
    assert vigil.is_over()


def test_launcher_that_waits_for_nobody_is_interrupted_when_the_study_is_over(watch):
    vigil, ledger, running = watch()
    began_s = time.monotonic()
    with vigil.interrupting():
        threading.Timer(0.3, ledger.study.tell, (running, 1.0)).start()
        time.sleep(60)
    assert 0.4 < time.monotonic() - began_s < 30


def test_launcher_that_is_interrupted_by_somebody_else_is_not_taken_for_done(watch):
    vigil, _, _ = watch()
    with pytest.raises(KeyboardInterrupt), vigil.interrupting():
        raise KeyboardInterrupt


def test_workers_are_waited_for_as_long_as_one_shows_signs_of_life(watch, monkeypatch):
    vigil, ledger, running = watch()
    monkeypatch.setattr("armscan.sweeps.lease.DEAD_AFTER_S", 0.1)
    assert not vigil.outlast()

    def live():
        for beat in range(40):
            ledger.renew(running, ELSEWHERE | {"beat": beat})
            time.sleep(0.03)
        ledger.study.tell(running, 1.0, TrialState.COMPLETE)

    living = threading.Thread(target=live)
    living.start()
    assert vigil.outlast()
    living.join()

"""A study that is watched from afar: when it is over, and whether anybody is at work."""

import threading
import time
from types import SimpleNamespace

import optuna
import pytest
from optuna.trial import TrialState

from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.scheduling.state import FINAL_SEED, FINALIST, METRICS, Limits
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.study import missing_final_trials
from armscan.sweeps.workers import monitor as module
from armscan.sweeps.workers.monitor import StudyMonitor
from tests.support.waiting import HANG_S

ELSEWHERE = {"worker": "0", "host": "elsewhere", "pid": 1, "started": "1"}


@pytest.fixture
def storage_uri(tmp_path):
    """It is the same in every storage."""
    return str(tmp_path / "a.journal")


@pytest.fixture
def watch(make_scheduler, storage_uri, monkeypatch):
    """Watches a study of two trials, in which one is running; returns the monitor, the schedulers and that trial."""
    for name, value in (("LOOK_S", 0.05), ("OVER_S", 0.2), ("LIFELESS_S", 60.0)):
        monkeypatch.setattr(module, name, value)

    def watch(top_k=0):
        scheduler = make_scheduler(n_trials=2)
        phases = [SimpleNamespace(name="a", scheduler=scheduler)]
        if top_k:
            storage = open_storage(storage_uri)
            final = optuna.create_study(study_name="a-judged", storage=storage.optuna)
            scheduler_of_final = TrialScheduler(final, storage, Limits(n_trials=9), is_open=False)
            phases.append(SimpleNamespace(name="a-judged", scheduler=scheduler_of_final))
        settings = SimpleNamespace(final_eval=SimpleNamespace(top_k=top_k, n_seeds=1), seeds=(0,))
        first, second = scheduler.claim(ELSEWHERE), scheduler.claim(ELSEWHERE)
        scheduler.study.tell(first, 1.0)
        opened = SimpleNamespace(phases=phases, search=phases[0], final_eval=phases[1] if top_k else None)
        opened.settings = watch.settings = settings
        return StudyMonitor(opened), *(phase.scheduler for phase in phases), second

    return watch


def test_study_is_over_when_enough_trials_have_finished_and_none_is_running(watch):
    monitor, scheduler, running = watch()
    assert not monitor.is_over()
    scheduler.study.tell(running, 1.0)
    assert monitor.is_over()


def test_study_is_over_when_its_final_evaluation_is(watch):
    monitor, scheduler, final, running = watch(top_k=1)
    scheduler.study.tell(running, 1.0)
    assert not monitor.is_over()
    ((best, seed),) = missing_final_trials(watch.settings, scheduler.study, final.study)
    final.study.enqueue_trial({}, user_attrs={FINALIST: best.number, FINAL_SEED: seed})
    assert not monitor.is_over()
    trial = final.study.ask()
    trial.set_user_attr(METRICS, {})
    final.study.tell(trial, 1.0)
    assert monitor.is_over()


def test_launcher_that_waits_for_nobody_is_interrupted_when_the_study_is_over(watch):
    monitor, scheduler, running = watch()
    with monitor.interrupting():
        threading.Timer(0.3, scheduler.study.tell, (running, 1.0)).start()
        time.sleep(HANG_S)
        pytest.fail("it was not interrupted")
    assert monitor.is_over()


def test_launcher_that_is_interrupted_by_somebody_else_is_not_taken_for_done(watch):
    monitor, _, _ = watch()
    with pytest.raises(KeyboardInterrupt), monitor.interrupting():
        raise KeyboardInterrupt


def test_workers_are_waited_for_as_long_as_one_shows_signs_of_life(watch, monkeypatch):
    monitor, scheduler, running = watch()
    monkeypatch.setattr("armscan.sweeps.workers.heartbeat.DEAD_AFTER_S", 0.1)
    monkeypatch.setattr(module, "LIFELESS_S", 0.3)
    assert not monitor.wait_until_over()
    monkeypatch.setattr(module, "LIFELESS_S", 60.0)

    def live():
        for beat in range(40):
            scheduler.renew(running, ELSEWHERE | {"beat": beat})
            time.sleep(0.03)
        scheduler.study.tell(running, 1.0, TrialState.COMPLETE)

    living = threading.Thread(target=live)
    living.start()
    assert monitor.wait_until_over()
    living.join()

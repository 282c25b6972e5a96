"""Monitoring a study whose workers run elsewhere: when it is over, and whether anybody is at work."""

import threading
import time
from dataclasses import asdict
from types import SimpleNamespace

import optuna
import pytest
from optuna.trial import TrialState

from armscan.sweeps.scheduling.claim import PlannedTrial
from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.storage.attribute_names import FINAL_SEED, FINALIST, LEASE, METRICS, STOP
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.workers import monitor as module
from armscan.sweeps.workers.monitor import StudyMonitor
from armscan.utils.processes import ProcessInfo
from tests.support.waiting import HANG_S

ELSEWHERE = {"worker": "0", "host": "elsewhere", "pid": 1, "started": "1"}


@pytest.fixture
def storage_uri(tmp_path):
    """Return one storage: monitoring is the same in every one."""
    return str(tmp_path / "a.journal")


@pytest.fixture
def watch(make_scheduler, storage_uri, monkeypatch):
    """Watch a study of two trials, in which one is running; return the monitor, the schedulers and that trial."""
    for name, value in (("POLL_S", 0.05), ("OVER_S", 0.2), ("LIFELESS_S", 60.0)):
        monkeypatch.setattr(module, name, value)

    def watch(n_final=0):
        scheduler = make_scheduler(n_trials=2)
        phases = [SimpleNamespace(name="a", scheduler=scheduler)]
        if n_final:
            storage = open_storage(storage_uri)
            final = optuna.create_study(study_name="a-judged", storage=storage.optuna)

            def plan():
                n_begun = len(final.get_trials(deepcopy=False))
                return [PlannedTrial({}, {FINALIST: 0, FINAL_SEED: seed}) for seed in range(n_begun, n_final)]

            scheduler_of_final = TrialScheduler(final, storage, Limits(n_trials=9), plan)
            phases.append(SimpleNamespace(name="a-judged", scheduler=scheduler_of_final))
        first, second = scheduler.claim(ELSEWHERE), scheduler.claim(ELSEWHERE)
        scheduler.study.tell(first, 1.0)
        return StudyMonitor(SimpleNamespace(phases=phases)), *(phase.scheduler for phase in phases), second

    return watch


def test_study_is_over_when_enough_trials_have_finished_and_none_is_running(watch):
    monitor, scheduler, running = watch()
    assert not monitor.is_over()
    scheduler.study.tell(running, 1.0)
    assert monitor.is_over()


def test_study_is_over_when_its_final_evaluation_is(watch):
    monitor, scheduler, final, running = watch(n_final=1)
    scheduler.study.tell(running, 1.0)
    assert not monitor.is_over()
    trial = final.claim(ELSEWHERE)
    assert not monitor.is_over()
    trial.set_user_attr(METRICS, {})
    final.study.tell(trial, 1.0)
    assert monitor.is_over()


def test_study_that_was_stopped_is_over_without_its_final_evaluation(watch):
    monitor, scheduler, _, running = watch(n_final=1)
    scheduler.study.tell(running, 1.0)
    scheduler.study.set_user_attr(STOP, "by me")
    assert monitor.is_over()


@pytest.mark.parametrize(("age_s", "is_worked_on"), [(5.0, True), (600.0, False)])
def test_study_is_worked_on_while_leases_are_renewed(watch, age_s, is_worked_on):
    monitor, scheduler, running = watch()
    # A dead worker of this machine, whose last heartbeat does not count.
    dead = asdict(ProcessInfo.current()) | {"worker": "1", "pid": 2**22, "beat": 1, "beat_s": time.time()}
    scheduler.study.ask().set_user_attr(LEASE, dead)
    running.set_user_attr(LEASE, ELSEWHERE | {"beat": 1, "beat_s": time.time() - age_s})
    assert monitor.is_worked_on() == is_worked_on


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

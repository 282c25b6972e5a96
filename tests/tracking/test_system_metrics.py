"""System metrics, sampled while a run trains."""

import errno
import os
import threading

import pytest

from armscan.tracking import TrackedRun
from armscan.tracking.system_metrics import SystemMetrics
from tests.support.stores import store_in
from tests.support.waiting import wait_until


@pytest.fixture
def store(tmp_path, database):
    return store_in(tmp_path, "test", system_metrics_s=0.05)


def threads():
    return [each for each in threading.enumerate() if each.name == "system metrics"]


def test_system_metrics_look_now_and_then_and_once_at_the_end():
    looks = []
    metrics = SystemMetrics(lambda figures, number: looks.append((number, figures)), every_s=0.05, first=7)
    wait_until(lambda: len(looks) >= 3)
    before = len(looks)
    metrics.finish()
    assert len(looks) > before
    assert [number for number, _ in looks] == list(range(7, 7 + len(looks)))
    for _, figures in looks:
        assert 0 <= figures["system/cpu_utilization_percentage"] <= 100
        assert figures["system/disk_available_megabytes"] > 0
    assert not threads()


def test_system_metrics_go_on_after_a_full_disk():
    numbers = []

    def take(_, number):
        numbers.append(number)
        if len(numbers) == 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    metrics = SystemMetrics(take, every_s=0.05, first=7)
    wait_until(lambda: len(numbers) >= 3)
    metrics.finish()
    assert numbers[:3] == [7, 7, 8]


def test_system_metrics_of_a_run_end_with_its_training_and_go_on_with_it(store, tmp_path):
    client, experiment_id = store
    first = TrackedRun.start(client, experiment_id, name="n", config={}, tags={}, folder=tmp_path)
    first.on_start(100, ())
    assert threads()
    first.on_end()
    assert not threads()
    first.end("KILLED", reason="interrupted")
    second = TrackedRun.reopen(client, client.get_run(first.run_id), folder=tmp_path, config={}, tags={})
    second.on_start(100, ())
    second.on_end()
    second.end("FINISHED")
    history = client.get_metric_history(first.run_id, "system/cpu_utilization_percentage")
    steps = [point.step for point in history]
    assert steps == list(range(len(steps)))
    assert len(steps) >= 2


def test_system_metrics_are_not_looked_at_where_nobody_wants_them(tmp_path, database):
    client, experiment_id = store_in(tmp_path, "test")
    with TrackedRun.start(client, experiment_id, name="n", config={}, tags={}, folder=tmp_path) as tracked:
        tracked.on_start(100, ())
        assert not threads()
        tracked.on_end()

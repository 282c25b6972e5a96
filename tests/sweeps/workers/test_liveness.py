"""A worker judges only processes that it can see, even if another machine has the same name."""

import os
import shutil
import subprocess
import sys
from dataclasses import asdict
from types import SimpleNamespace

import pytest
from optuna.trial import TrialState

from armscan.sweeps.storage.attribute_names import LEASE
from armscan.sweeps.workers import heartbeat
from armscan.sweeps.workers.heartbeat import LivenessCheck
from armscan.sweeps.workers.supervisor import local_workers
from armscan.utils.processes import ProcessInfo
from tests.support.requirements import unavailable
from tests.support.waiting import HANG_S

IN_A_NAMESPACE = ("unshare", "--pid", "--fork", "--kill-child", "--mount-proc")
DEAD = {"pid": 2**22 + 1, "started": "1"}
WORK = """
import functools, sys
from tests.sweeps.conftest import scheduler_at
from tests.sweeps.scheduling.test_scheduler import work
work(functools.partial(scheduler_at, sys.argv[1]), 20)
"""


@pytest.fixture
def unshare():
    """Yield a function that starts Python in its own PID namespace, where its process ID is 1."""
    if shutil.which("unshare") is None or subprocess.run([*IN_A_NAMESPACE, "true"], capture_output=True).returncode:
        unavailable("no PID namespace can be made here: it needs util-linux and root")
    started = []

    def start(program, *words):
        command = [*IN_A_NAMESPACE, sys.executable, "-c", program, *words]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def is_dead(lease, *, monkeypatch):
    """Return whether a worker takes another for dead at the first check, and after 50 s without a heartbeat."""
    now_s, liveness = [100.0], LivenessCheck()
    monkeypatch.setattr(heartbeat.time, "monotonic", lambda: now_s[0])
    trial, said = SimpleNamespace(number=0, user_attrs={LEASE: lease}), []
    for _ in range(6):
        said.append(liveness.is_dead(trial))
        now_s[0] += 10.0
    return said[0], said[-1]


def test_worker_whose_process_is_gone_is_dead_at_once(monkeypatch):
    lease = asdict(ProcessInfo.current()) | {"worker": "a", "beat": 0}
    assert is_dead(lease, monkeypatch=monkeypatch) == (False, False)
    assert is_dead(lease | DEAD, monkeypatch=monkeypatch) == (True, True)
    # Requeued by a process that is gone, and claimed by one that died before it could write its own lease.
    assert is_dead(lease | DEAD | {"started": ""}, monkeypatch=monkeypatch) == (True, True)


@pytest.mark.parametrize("key", ["host", "boot", "pid_namespace"])
@pytest.mark.parametrize("other", ["another", ""])
def test_only_time_says_of_a_process_of_another_host_boot_or_namespace_that_it_is_dead(monkeypatch, key, other):
    lease = asdict(ProcessInfo.current()) | {"worker": "a", "beat": 0, key: other}
    for each in (lease, lease | DEAD):
        assert is_dead(each, monkeypatch=monkeypatch) == (False, True)


def test_only_time_says_of_a_lease_of_an_earlier_version_that_its_worker_is_dead(monkeypatch):
    lease = {"worker": "a", "host": os.uname().nodename, **DEAD, "beat": 0}
    assert is_dead(lease, monkeypatch=monkeypatch) == (False, True)


def test_process_file_of_an_earlier_version_is_read_and_its_process_not_judged(tmp_path):
    (tmp_path / "worker-0.json").write_text(f'{{"host": "{os.uname().nodename}", "pid": 1, "started": "1"}}')
    process = ProcessInfo.read(tmp_path / "worker-0.json")
    assert (process.is_here, process.is_alive) == (False, True)
    # No process is killed for having the ID of a worker.
    assert local_workers(tmp_path) == []


def test_process_of_another_pid_namespace_is_not_looked_up_in_this_one(tmp_path, unshare):
    outer, inner = tmp_path / "worker-0.json", tmp_path / "worker-1.json"
    ProcessInfo.current().write(outer)
    program = """
import sys
from pathlib import Path
from armscan.utils.processes import ProcessInfo
outer, inner = map(Path, sys.argv[1:])
ProcessInfo.current().write(inner)
print(ProcessInfo.current().pid, ProcessInfo.read(outer).is_here, ProcessInfo.read(outer).is_alive, flush=True)
sys.stdin.read()
"""
    told = unshare(program, str(outer), str(inner)).stdout.readline().split()
    assert told == ["1", "False", "True"]
    other, own = ProcessInfo.read(inner), ProcessInfo.current()
    assert (other.host, other.boot, other.pid) == (own.host, own.boot, 1)
    assert (other.is_here, other.is_alive, other.is_current) == (False, True, False)
    assert local_workers(tmp_path) == [own]


def test_workers_of_one_host_name_in_two_pid_namespaces_lose_no_trial_to_each_other(
    make_scheduler, storage_uri, unshare
):
    scheduler = make_scheduler(n_trials=20)
    workers = [unshare(WORK, storage_uri) for _ in range(2)]
    assert [worker.wait(HANG_S) for worker in workers] == [0, 0]
    assert [trial.state for trial in scheduler.study.trials] == [TrialState.COMPLETE] * 20
    assert {trial.user_attrs[LEASE]["pid"] for trial in scheduler.study.trials} == {1}
    assert len({trial.user_attrs[LEASE]["pid_namespace"] for trial in scheduler.study.trials}) == 2

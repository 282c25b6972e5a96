"""Jobs of a grid, each in its own process."""

import io
import json
import os
import pickle
import signal
from types import SimpleNamespace

import pytest

from armscan.experiment import runner
from armscan.experiment.job import Grid, Invocation, Job
from armscan.launch import job_process
from armscan.utils.processes import interruptions

GRID = Grid(run_id="b", tracking={}, overrides=[], shared=[])


@pytest.fixture
def handlers():
    """Restore the signal handlers that a job sets in its process."""
    before = {each: signal.getsignal(each) for each in interruptions()}
    yield
    for each, handler in before.items():
        signal.signal(each, handler)


def test_job_whose_folder_is_another_jobs_fails_and_touches_nothing(tmp_path, monkeypatch, capsys):
    (tmp_path / "outcomes").mkdir()
    started = []
    monkeypatch.setattr(
        job_process.subprocess, "run", lambda *_, **__: started.append(1) or SimpleNamespace(returncode=0)
    )
    jobs = [Job(number, f"a={number}", "", tmp_path, GRID) for number in (0, 1, 0)]
    for job in jobs:
        job_process.start_job(None, Invocation(tmp_path / "same", [], "", {}, job), job)
    # The first job may be started again, as after a requeue.
    assert len(started) == 2
    assert "is another job's: hydra.sweep.subdir must differ between jobs" in capsys.readouterr().err
    outcomes = [json.loads((tmp_path / "outcomes" / f"{number}.json").read_text())["failure"] for number in (0, 1)]
    assert outcomes[0] == job_process.NO_OUTCOME
    assert "another job's" in outcomes[1]


def test_interrupt_after_the_end_of_a_job_leaves_its_outcome_as_it_is(tmp_path, monkeypatch, handlers):
    (tmp_path / "outcomes").mkdir()
    job = Job(0, "a=1", "a=1", tmp_path, GRID)
    invocation = Invocation(tmp_path, [], "", {}, job)
    metrics = {"test": {"mean_steps": 1.0}}
    monkeypatch.setattr(runner, "run_experiment", lambda *_: metrics)
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(pickle.dumps((None, invocation)))))
    monkeypatch.setattr(job_process, "on_parent_exit", lambda *_: None)
    job_process.run_job(os.getppid())
    # As the interpreter ends.
    os.kill(os.getpid(), signal.SIGINT)
    (outcome,) = tmp_path.glob("outcomes/*")
    assert json.loads(outcome.read_text())["metrics"] == metrics

"""Multiruns: the overrides that their jobs share, the address of their store, and their end."""

import contextlib
import json
import sys
from dataclasses import asdict
from unittest.mock import Mock

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from mlflow.entities import Metric
from omegaconf import OmegaConf

from armscan import run
from armscan.config.error_messages import one_line_message
from armscan.errors import ArmscanError, InvalidValueError, ResumeError
from armscan.experiment.job import GRID_FILE, INTERRUPTED, OUTCOME_FOLDER, Grid, JobOutcome
from armscan.launch import multirun
from armscan.launch.grid_jobs import shared_overrides
from armscan.launch.multirun import Multirun, end_grid
from armscan.tracking import begin_outbox, sync
from armscan.tracking.git import COMMIT
from armscan.tracking.tags import BEST_TAG, CONTINUED_TAG, FOLDER_TAG, JOB_TAG, OWN_CODE_TAG, PARENT_TAG
from armscan.utils.processes import ProcessInfo
from tests.support.stores import store_in


@pytest.mark.parametrize("uri", ["sqlite:///mlruns.db", "sqlite:////tmp/it's.db", r"sqlite:////tmp/a\\'b.db"])
def test_address_of_the_store_is_read_again_as_it_was(uri):
    word = f"tracking.uri={QuotedString(uri, Quote.single).with_quotes()}"
    assert OverridesParser.create().parse_override(word).value() == uri


@pytest.mark.parametrize("is_interrupted", [True, False])
def test_interrupt_while_a_grid_is_closed_leaves_the_command_that_resumes_it(monkeypatch, capsys, is_interrupted):
    grid = Grid(run_id="a" * 32, tracking={"uri": "sqlite:///mine.db"}, overrides=[], shared=[])
    monkeypatch.setattr(Multirun, "grid", grid)
    monkeypatch.setattr(run, "end_grid", Mock(side_effect=KeyboardInterrupt))
    assert run._end_grid(is_interrupted=is_interrupted) == 130
    told = capsys.readouterr().err
    assert told.startswith("the grid was not closed; resume it with: ")
    assert f"resume={'a' * 32} tracking.uri=sqlite:///mine.db" in told


def test_error_while_an_interrupted_grid_is_closed_is_shown(monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    def fail(**_):
        raise LookupError("of the end")

    monkeypatch.setattr(run, "launch", interrupt)
    monkeypatch.setattr(run, "end_grid", fail)
    monkeypatch.setattr("sys.argv", ["armscan.run", "seed=1"])
    # The command sets it, and would take it for the user's setting the next time.
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    with pytest.raises(LookupError, match="of the end"):
        run.main()


def test_job_that_was_stopped_alone_has_not_failed(tmp_path, database, monkeypatch, capsys):
    store, experiment_id = store_in(tmp_path, "a")
    parent = store.create_run(experiment_id, name="multirun", tags={}).info.run_id
    tracking = {"uri": store.uri, "experiment": "a", "artifacts": str(tmp_path / "artifacts"), "wait_s": 60.0}
    grid = Grid(run_id=parent, tracking=tracking, overrides=["seed=0,1"], shared=[])
    (tmp_path / OUTCOME_FOLDER).mkdir()
    jobs = []
    for number, failure in enumerate((INTERRUPTED, None, None)):
        outcome = JobOutcome(f"seed={number}", f"seed={number}", failure)
        (tmp_path / OUTCOME_FOLDER / f"{number}.json").write_text(json.dumps(asdict(outcome)))
        tags = {JOB_TAG: str(number), FOLDER_TAG: str(tmp_path / str(number)), PARENT_TAG: parent}
        tags |= {OWN_CODE_TAG: f"mine:01 parts:{number}", COMMIT: f"{number:040}"}
        jobs.append(store.create_run(experiment_id, name="job", tags=tags).info.run_id)
        if failure is None:
            store.set_terminated(jobs[-1], "FINISHED")
    # It was stopped after its evaluation: its table shows no result.
    for job, rate in zip(jobs, (0.9, 0.4, 0.3), strict=True):
        store.log_batch(job, metrics=[Metric("test_volumes/on_plane_5mm_10deg", rate, 1, 0)])
    monkeypatch.setattr(Multirun, "folder", tmp_path)
    monkeypatch.setattr(Multirun, "grid", grid)
    assert end_grid() == 1
    assert [store.get_run(run_id).info.status for run_id in jobs] == ["KILLED", "FINISHED", "FINISHED"]
    assert store.get_run(parent).info.status == "KILLED"
    printed = capsys.readouterr()
    assert "failed" not in printed.err
    assert "note: the jobs used different versions of parts (tag own_code)" in printed.out
    assert "note: the jobs used different versions of armscan's code (tags armscan.version, git.commit" in printed.out
    assert store.get_run(parent).data.tags[BEST_TAG] == jobs[1]


@pytest.mark.parametrize("is_there", [True, False])
def test_grid_that_another_one_continues_is_not_resumed_a_second_time(tmp_path, database, is_there):
    store, experiment_id = store_in(tmp_path, "a")
    later = store.create_run(experiment_id, name="later", tags={}).info.run_id
    grid = store.create_run(experiment_id, name="grid", tags={CONTINUED_TAG: later}).info.run_id
    if not is_there:
        store.delete_run(later)
    expected = pytest.raises(ResumeError, match=f"is continued by run {later}: resume that one, resume={later}")
    with expected if is_there else contextlib.nullcontext():
        multirun._check_not_continued(store, experiment_id, grid)
    multirun._check_not_continued(store, experiment_id, later if is_there else grid)


def test_damaged_file_of_a_grid_is_one_line(tmp_path):
    (tmp_path / GRID_FILE).write_text("{")
    with pytest.raises(InvalidValueError, match=f"{tmp_path}/{GRID_FILE}: is damaged"):
        Grid.read(tmp_path)


def test_run_of_a_grid_whose_launcher_has_died_is_closed(tmp_path, database, monkeypatch):
    store, experiment_id = store_in(tmp_path, "a")
    parent = store.create_run(experiment_id, name="multirun", tags={}).info.run_id
    begin_outbox(tmp_path, parent, store.uri).close()
    sync(tmp_path, lambda _: store)
    assert store.get_run(parent).info.status == "RUNNING"
    monkeypatch.setattr(ProcessInfo, "is_alive", False)
    sync(tmp_path, lambda _: store)
    assert store.get_run(parent).info.status == "FAILED"


def test_setting_of_tracking_that_nothing_reads_is_one_line(tmp_path, capsys):
    choices = {"hydra/launcher": "basic", "hydra/sweeper": "basic"}
    of_hydra = {
        "runtime": {"choices": choices},
        "sweep": {"dir": str(tmp_path)},
        "overrides": {"task": [], "hydra": []},
    }
    tracking = {"uri": "sqlite:///a.db", "experiment": "a", "artifacts": "a", "wait_s": 1.0, "foo": 1}
    with pytest.raises(SystemExit):
        Multirun().on_multirun_start(OmegaConf.create({"hydra": of_hydra, "tracking": tracking}))
    assert "error: there is no key 'foo' in tracking, but only uri" in capsys.readouterr().err


def test_override_of_all_jobs_is_recognised_however_hydra_spells_it():
    words = ["agent.lr=1e-3", "env.transform={rx_deg: 1.0}", "stack_memory=false", "data.path='a b'", "seed=1"]
    words += ["~data.folds", "+x=[1, 2]", "seed=3,4"]
    ((first, second),) = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(words), None)
    common = shared_overrides(OverridesParser.create().parse_overrides(words))
    assert [[word for word in job if word not in common] for job in (first, second)] == [["seed=3"], ["seed=4"]]


@pytest.mark.parametrize(
    ("launcher", "is_told"), [("ray", True), ("submitit_slurm", True), ("joblib", False), (None, False)]
)
def test_error_of_a_launcher_for_other_machines_is_one_line(monkeypatch, launcher, is_told):
    def refuse(_):
        def refused():
            raise ConnectionError("Could not find any running Ray instance")

        return refused

    monkeypatch.setattr(run, "application", refuse)
    monkeypatch.setattr(Multirun, "launcher", launcher)
    with pytest.raises(ArmscanError if is_told else ConnectionError) as raised:
        run.launch(sys.argv[1:])
    if is_told:
        line = f"hydra/launcher is {launcher!r}, which has failed: Could not find any running Ray instance"
        assert one_line_message(raised.value) == line

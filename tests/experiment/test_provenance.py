"""The files that describe the origin of a run."""

from unittest.mock import Mock

import pytest

from armscan.config.compose import compose_run
from armscan.experiment.build import set_up
from armscan.experiment.job import Invocation
from armscan.experiment.provenance import start_tracking
from armscan.runs.query import projection_of
from armscan.tracking import TrackedRun, open_existing_store
from armscan.tracking.git import CodeState
from tests.support.tracked_runs import FEW


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ([], "random-cluster-y-phantom-seed0"),
        (["env.projection=zy", "env.stack=2", "env.memory=1"], "random-cluster-zy-stack2-memory1-phantom-seed0"),
        (["env.observation=[slice,cluster]"], "random-slice+cluster-y-phantom-seed0"),
        (["obs=slice", "env.observation=cluster"], "random-cluster-y-phantom-seed0"),
        (["reward=agreement", "env.success_threshold=0.5"], "random-cluster-y-agreement-phantom-seed0"),
    ],
)
def test_name_and_tags_of_a_run_are_of_its_environment(tmp_path, database, monkeypatch, words, name):
    monkeypatch.chdir(tmp_path)
    config, choices = compose_run([*FEW, "agent=random", *words])
    tracked = start_tracking(config, Invocation(tmp_path, [], "", choices), set_up(config))
    tracked.end("FINISHED")
    run = open_existing_store(database).get_run(tracked.run_id)
    assert run.info.run_name == name
    assert run.data.tags["choice.obs"] == name.split("-")[1]
    assert projection_of(run) == name.split("-")[2]


def test_run_that_is_interrupted_while_it_is_created_is_closed(tmp_path, database, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(TrackedRun, "log_datasets", Mock(side_effect=KeyboardInterrupt))
    config, choices = compose_run([*FEW, "agent=random"])
    with pytest.raises(KeyboardInterrupt):
        start_tracking(config, Invocation(tmp_path, [], "", choices), set_up(config))
    client = open_existing_store(database)
    (run,) = client.search_runs([each.experiment_id for each in client.search_experiments()])
    assert (run.info.status, run.data.tags["failure"]) == ("KILLED", "interrupted")


def test_new_run_keeps_nothing_of_an_earlier_one_in_its_folder(tmp_path, database, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("armscan.experiment.provenance.code_state", lambda: CodeState("unknown", None))
    left = ("policy/MLmodel", "code.diff", "resumed_1_code.diff", "reproduction.json", "best.pt")
    (tmp_path / "policy").mkdir()
    for name in (*left, "mine.txt"):
        (tmp_path / name).touch()
    config, choices = compose_run([*FEW, "agent=random"])
    start_tracking(config, Invocation(tmp_path, [], "", choices), set_up(config)).end("FINISHED")
    assert not [name for name in left if (tmp_path / name).exists()]
    assert (tmp_path / "mine.txt").exists()

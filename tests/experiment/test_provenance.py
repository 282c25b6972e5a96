"""The files that describe the origin of a run."""

from armscan.config.compose import compose_run
from armscan.experiment.build import set_up
from armscan.experiment.job import Invocation
from armscan.experiment.provenance import start_tracking
from armscan.tracking.environment import Source
from tests.support.tracked_runs import FEW


def test_new_run_keeps_nothing_of_an_earlier_one_in_its_folder(tmp_path, database, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("armscan.experiment.provenance.source", lambda: Source("unknown", None))
    left = ("policy/MLmodel", "code.diff", "resumed_1_code.diff", "reproduction.json", "best.pt")
    (tmp_path / "policy").mkdir()
    for name in (*left, "mine.txt"):
        (tmp_path / name).touch()
    config, choices = compose_run([*FEW, "agent=random"])
    start_tracking(config, Invocation(tmp_path, [], "", choices, None), set_up(config)).end("FINISHED")
    assert not [name for name in left if (tmp_path / name).exists()]
    assert (tmp_path / "mine.txt").exists()

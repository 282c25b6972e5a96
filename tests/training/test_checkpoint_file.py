"""Checkpoints."""

import hashlib
import io
import json
import os
import pickle

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armscan.errors import ChangedVolumesError, CheckpointError
from armscan.training import CheckpointProvenance, load_checkpoint, resume_from_checkpoint, save_checkpoint
from armscan.training.episode_results import EPISODE_FIELDS


def test_checkpoint_gives_back_what_was_saved(tmp_path):
    state = {"weights": torch.arange(3.0), "optimisers": [{"lr": 0.1}]}
    save_checkpoint(tmp_path / "a.pt", state, {"n_env_steps": 7})
    loaded, facts = load_checkpoint(tmp_path / "a.pt")
    assert torch.equal(loaded["weights"], state["weights"])
    assert (loaded["optimisers"], facts) == ([{"lr": 0.1}], {"n_env_steps": 7})
    assert [file.name for file in tmp_path.iterdir()] == ["a.pt"]


def test_failing_save_leaves_the_old_checkpoint(tmp_path):
    save_checkpoint(tmp_path / "a.pt", {"weights": 1}, {})
    with pytest.raises(Exception, match="pickle"):
        save_checkpoint(tmp_path / "a.pt", {"weights": lambda: None}, {})
    assert load_checkpoint(tmp_path / "a.pt")[0] == {"weights": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["a.pt"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.pt"
    save_checkpoint(path, {"weights": torch.arange(300.0), "names": ["a", "b"]}, {"n_env_steps": 7})
    return path.read_bytes()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_truncated_checkpoint_is_refused(tmp_path, whole, data):
    kept = data.draw(st.integers(0, len(whole) - 1))
    (tmp_path / "a.pt").write_bytes(whole[:kept])
    with pytest.raises(CheckpointError, match=r"a\.pt: is (empty|damaged|not a checkpoint)") as refused:
        load_checkpoint(tmp_path / "a.pt")
    assert len(str(refused.value).splitlines()) == 1


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_tampered_checkpoint_is_refused(tmp_path, whole, data):
    # As often within the first line as anywhere else.
    place = data.draw(st.integers(0, 90) | st.integers(0, len(whole) - 1))
    flipped = data.draw(st.integers(1, 255))
    changed = bytearray(whole)
    changed[place] ^= flipped
    (tmp_path / "a.pt").write_bytes(changed)
    with pytest.raises(CheckpointError, match=r"a\.pt: is (damaged|not a checkpoint|a checkpoint of format)"):
        load_checkpoint(tmp_path / "a.pt")


@pytest.mark.parametrize("added", [b"x", b"\0" * 1000])
def test_checkpoint_with_something_added_is_refused(tmp_path, whole, added):
    (tmp_path / "a.pt").write_bytes(whole + added)
    with pytest.raises(CheckpointError, match="is damaged"):
        load_checkpoint(tmp_path / "a.pt")


def test_checkpoint_of_a_newer_version_is_refused(tmp_path, whole):
    (tmp_path / "a.pt").write_bytes(whole.replace(b"checkpoint 1 ", b"checkpoint 2 ", 1))
    with pytest.raises(CheckpointError, match=r"of format 2, but this version of armscan reads 1: .* a newer version"):
        load_checkpoint(tmp_path / "a.pt")


def test_other_files_are_no_checkpoints(tmp_path):
    torch.save({"state": {}, "facts": {}}, tmp_path / "a.pt")
    (tmp_path / "b.pt").write_text("weights: 3\n")
    (tmp_path / "c.pt").mkdir()
    for name, message in (("a", "is not a checkpoint of"), ("b", "is not a checkpoint of"), ("c", "cannot be read")):
        with pytest.raises(CheckpointError, match=rf"{name}\.pt: {message}"):
            load_checkpoint(tmp_path / f"{name}.pt")


def test_named_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.pt")
    with pytest.raises(CheckpointError, match=r"a\.pt: is a named pipe"):
        load_checkpoint(tmp_path / "a.pt")


def test_missing_checkpoint_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"a\.pt: there is no such checkpoint"):
        load_checkpoint(tmp_path / "a.pt")


class Malicious:
    def __reduce__(self):
        return (print, ("this must not run",))


def with_a_right_sum(contents):
    return f"armscan checkpoint 1 {hashlib.sha256(contents).hexdigest()}\n".encode() + contents


@pytest.mark.parametrize("is_zipped", [True, False])
def test_checkpoint_runs_no_code_from_the_file(tmp_path, capsys, is_zipped):
    file = io.BytesIO()
    if is_zipped:
        torch.save({"state": Malicious(), "facts": {}}, file)
    else:
        pickle.dump({"state": Malicious(), "facts": {}}, file, protocol=2)
    (tmp_path / "a.pt").write_bytes(with_a_right_sum(file.getvalue()))
    with pytest.raises(CheckpointError, match="something other than tensors, numbers and strings"):
        load_checkpoint(tmp_path / "a.pt")
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("content", [3, [1], {"state": {}}, {"state": 3, "facts": {}}, {"state": {}, "facts": 3}])
def test_checkpoint_that_holds_something_else_is_refused(tmp_path, content):
    file = io.BytesIO()
    torch.save(content, file)
    (tmp_path / "a.pt").write_bytes(with_a_right_sum(file.getvalue()))
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        load_checkpoint(tmp_path / "a.pt")


ERRORS = KeyError("replay"), TypeError("3"), AttributeError("numpy"), RuntimeError("shape"), AssertionError("rows")


@pytest.mark.parametrize(
    ("error", "message"),
    [*((error, "does not hold the state of this agent: ") for error in ERRORS), (None, "has taken 8 .* reports 7")],
)
def test_state_that_no_learner_takes_is_refused(tmp_path, error, message):
    class Learner:
        n_env_steps = 8

        def load_state(self, state):
            if error is not None:
                raise error

    report = {"epoch": 1, "n_env_steps": 7, "wall_s": 1.0, "metrics": {}, "is_best": True}
    reports = json.dumps([report | {"episodes": {name: [] for name in EPISODE_FIELDS}}])
    facts = CheckpointProvenance().facts() | {"reports": reports}
    save_checkpoint(tmp_path / "last.pt", {}, facts)
    with pytest.raises(CheckpointError, match=rf"last\.pt: .*{message}"):
        resume_from_checkpoint(Learner(), tmp_path, CheckpointProvenance())
    save_checkpoint(tmp_path / "last.pt", {}, facts | {"volumes": [3]})
    with pytest.raises(ChangedVolumesError, match=r"last\.pt: is not a record of volumes"):
        resume_from_checkpoint(Learner(), tmp_path, CheckpointProvenance())

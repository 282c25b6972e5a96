"""Checkpoints."""

import pickle

import pytest
import torch

from armscan.errors import CheckpointError
from armscan.training import load_checkpoint, save_checkpoint


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


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_truncated_checkpoint_is_refused(tmp_path, kept):
    save_checkpoint(tmp_path / "a.pt", {"weights": torch.arange(1000.0)}, {})
    whole = (tmp_path / "a.pt").read_bytes()
    (tmp_path / "a.pt").write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(CheckpointError, match=r"a\.pt: is no checkpoint, or damaged"):
        load_checkpoint(tmp_path / "a.pt")


def test_missing_checkpoint_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"a\.pt: there is no such checkpoint"):
        load_checkpoint(tmp_path / "a.pt")


class Malicious:
    def __reduce__(self):
        return (print, ("this must not run",))


def test_checkpoint_runs_no_code_from_the_file(tmp_path, capsys):
    torch.save({"state": Malicious(), "facts": {}}, tmp_path / "a.pt", pickle_module=pickle)
    with pytest.raises(CheckpointError):
        load_checkpoint(tmp_path / "a.pt")
    assert capsys.readouterr().out == ""

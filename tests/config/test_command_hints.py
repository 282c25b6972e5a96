"""The commands that messages suggest can be typed as they stand."""

import sys

import pytest

from armscan.config import command_hints
from armscan.config.command_hints import UV_RUN, armscan_command, kept_command, run_command


@pytest.fixture
def environment(tmp_path, monkeypatch):
    """Yield a virtual environment in the working folder, with Python and the program; none is activated."""
    folder = tmp_path / ".venv" / "bin"
    folder.mkdir(parents=True)
    for name in ("python", "armscan"):
        (folder / name).touch(mode=0o755)
    monkeypatch.setattr(command_hints, "STARTED_IN", tmp_path)
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv(UV_RUN, raising=False)
    command_hints.typed.cache_clear()
    yield folder
    command_hints.typed.cache_clear()


def test_path_is_typed_where_nothing_is_activated(environment):
    assert armscan_command("ui").startswith(".venv/bin/armscan ui")
    assert run_command(["seed=1"]) == ".venv/bin/python -m armscan.run seed=1"


def test_path_is_absolute_elsewhere(environment, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.setattr(command_hints, "STARTED_IN", tmp_path / "elsewhere")
    assert armscan_command("ui").startswith(f"{environment}/armscan ui")


def test_name_is_typed_where_the_environment_is_activated(environment, monkeypatch):
    monkeypatch.setenv("PATH", str(environment))
    assert armscan_command("ui").startswith("armscan ui")
    assert run_command([]) == "python -m armscan.run"


def test_path_is_typed_where_another_environment_is_activated(environment, tmp_path, monkeypatch):
    other = tmp_path / "other"
    other.mkdir()
    (other / "python").symlink_to(environment / "python")
    monkeypatch.setenv("PATH", str(other))
    assert run_command([]) == ".venv/bin/python -m armscan.run"


def test_uv_run_is_typed_where_it_was(environment, monkeypatch):
    monkeypatch.setenv(UV_RUN, "1")
    assert armscan_command("ui").startswith("uv run armscan ui")


def test_command_that_is_kept_holds_on_every_machine(environment):
    assert kept_command(["seed=1"]) == "python -m armscan.run seed=1"

"""Imports of commands before they answer; benchmarks/speed/commands.py measures how long they take."""

import shutil
import subprocess
import sys

import pytest

from tests.support.programs import imported_by

LEARNING = {"torch", "tianshou", "ray", "tensorboard", "pettingzoo"}
HEAVY = LEARNING | {"mlflow", "optuna", "matplotlib", "pandas", "plotly", "scipy.stats", "sqlalchemy"}
# Runs commands one after another, then prints their exit codes and the imported modules.
PROGRAM = """
import os, sys
from armscan.cli.main import main
def code(words):
    # Set by the command before; usually a process runs only one.
    os.environ.pop("HYDRA_FULL_ERROR", None)
    try:
        return main(words.split())
    except SystemExit as error:
        return error.code
print(*[code(words) for words in sys.argv[1:]])
print(*sys.modules)
"""


def after(folder, *commands):
    """Return the exit codes of commands in a fresh process, their standard error, and the modules it has imported."""
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM, *commands], cwd=folder, capture_output=True, text=True, check=True
    )
    *_, codes, modules = ran.stdout.splitlines()
    return [int(code) for code in codes.split()], ran.stderr, set(modules.split())


@pytest.mark.parametrize(
    ("modules", "absent"),
    [
        ("armscan, armscan.envs, armscan.anatomy", LEARNING | {"hydra", "mlflow", "optuna"}),
        ("armscan.volumes", {"SimpleITK", "slicerio", "pydantic", "torch", "hydra", "mlflow"}),
        ("armscan.agents", {"optuna"}),
        ("armscan.cli.main", HEAVY | {"hydra", "SimpleITK"}),
        ("armscan.cli.main, armscan.annotation.explorer", LEARNING | {"hydra", "mlflow"}),
        ("armscan.cli.main, armscan.annotation.labelling", LEARNING | {"hydra", "mlflow"}),
        ("armscan.cli.main, armscan.ui.show", LEARNING | {"mlflow", "optuna", "sqlalchemy"}),
        ("armscan.run, armscan.sweeps.workers.supervisor", LEARNING | {"mlflow"}),
    ],
)
def test_import_loads_nothing_that_is_not_needed_yet(modules, absent):
    assert not absent & imported_by(f"import {modules}")


def test_words_that_are_wrong_are_answered_before_a_library_of_learning_or_tracking_is_loaded(tmp_path):
    wrong = {
        "training.env_steps=-1": "training.env_steps is -1",
        "agent.lr=0": "agent.lr is 0",
        "agent=ppo agent.clip_range=-1": "agent.clip_range is -1",
        "network=mlp network.hidden_sizes=[0]": "network.hidden_sizes",
        "env.max_steps=0": "max_steps is 0",
        "tracking.wait_s=-1": "tracking.wait_s is -1",
        "evaluation.episodes=0": "evaluation.episodes is 0",
        "data=nifti": "data.path is not set",
        "data=nifti data.path=nowhere": "nowhere",
        "resume=zzzz": "the run is 'zzzz'",
        "resume=abcd": "no run was tracked there",
        "agent=sca": "agent is 'sca'",
        "foo=1": "there is no key 'foo'",
        "-m training.env_steps=-1,-9": "training.env_steps is -1",
        "-m data=nifti seed=0,1": "data.path is not set",
        "-m sweep=sac_y training.env_steps=-1": "training.env_steps is -1",
        "-m sweep=sac_y data=nifti": "data.path is not set",
        "-m sweep=sac_y agent=sac,ppo": "'agent=sac,ppo' gives several values",
    }
    codes, said, modules = after(tmp_path, *(f"run {words}" for words in wrong))
    assert codes == [2] * len(wrong)
    for line, part in zip(said.splitlines(), wrong.values(), strict=True):
        assert part in line
    assert not HEAVY & modules


def test_runs_are_listed_and_compared_without_a_library_of_learning(tmp_path):
    (tmp_path / "mlruns.db").touch()
    codes, said, modules = after(tmp_path, "runs list", "report --runs abcd", "evaluate abcd")
    assert codes == [2, 2, 2]
    assert said.count("not an MLflow store") == 3
    assert not LEARNING & modules


def test_runs_of_a_store_are_listed_without_what_only_trainings_and_reports_need(tmp_path, empty_database):
    shutil.copy(empty_database, tmp_path / "mlruns.db")
    codes, _, modules = after(tmp_path, "runs list", "report --runs abcd")
    assert codes == [0, 2]
    assert not (LEARNING | {"numba", "plotly", "optuna", "matplotlib", "armscan.training"}) & modules


@pytest.mark.parametrize("command", ["runs", "report", "ui", "data", "evaluate", "policy"])
def test_help_needs_nothing_else(command, tmp_path):
    _, _, modules = after(tmp_path, f"{command} --help")
    assert not (HEAVY | {"numba", "hydra"}) & modules

"""A study in PostgreSQL, as a person starts it."""

import os
import subprocess
import sys
from pathlib import Path

import optuna
import pytest

from armscan.errors import StudyError
from armscan.sweeps.database import PASSWORD_VARIABLE, url_of
from armscan.sweeps.storage import open_storage
from tests.postgres import PASSWORD

REPOSITORY = Path(__file__).parents[2]
# Trials that only wait.
WORDS = [
    *("-m", "sweeps=sac_y", "study.task._target_=benchmarks.sleeping.Sleeping", "study/pruner=none", "study.workers=1"),
    *("study.n_trials=2", "study.judging.best=0", "data.n_training=1", "data.n_validation=1", "data.n_test=1"),
    "+study.space={training.env_steps:{low:100,high:200},agent.lr:{low:1.0e-4,high:1.0e-2}}",
]


def test_study_in_postgresql_runs_and_shows_its_password_nowhere(postgres, tmp_path):
    uri = postgres.make_database()
    ended = subprocess.run(
        [sys.executable, "-m", "armscan.run", *WORDS, f"study.storage={uri}"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    assert ended.stdout.count("\ntrial ") == 2
    study = optuna.load_study(study_name="sac_y", storage=open_storage(uri).optuna)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 2
    files = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert {"mlruns.db", "multirun.yaml", "worker-0.log"} <= {file.name for file in files}
    assert PASSWORD not in ended.stdout
    assert [file for file in files if PASSWORD.encode() in file.read_bytes()] == []


def test_address_uses_psycopg_and_the_password_that_was_handed_over(monkeypatch):
    monkeypatch.setenv(PASSWORD_VARIABLE, "a:b@c")
    assert url_of("postgresql://me@host/db").render_as_string(hide_password=False) == (
        "postgresql+psycopg://me:a%3Ab%40c@host/db"
    )
    assert url_of("postgresql://me:other@host/db").password == "other"
    assert url_of("sqlite:///a.db").password is None


def test_study_in_postgresql_without_psycopg_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(StudyError, match=r"but psycopg is not installed: pip install 'armscan\[postgres\]'"):
        open_storage("postgresql://me:secret@127.0.0.1:1/db")

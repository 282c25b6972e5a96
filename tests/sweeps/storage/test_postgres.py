"""A study on services that many machines share, as a user starts it."""

import contextlib
import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import optuna
import pytest
from mlflow import MlflowClient

from armscan.config.credentials import STORAGE_PASSWORD, database_url
from armscan.errors import StudyError
from armscan.sweeps.storage.storage import open_storage
from tests.support import FEW_VOLUMES, REPOSITORY
from tests.support.postgres import PASSWORD

# Trials that only wait.
WORDS = [
    *(
        "-m",
        "sweep=sac_y",
        "study.task._target_=benchmarks.sweeps.sleeping.Sleeping",
        "study/pruner=none",
        "study.workers=1",
    ),
    *("study.n_trials=2", "study.final_eval.top_k=0", *FEW_VOLUMES),
    "+study.space={training.env_steps:{low:100,high:200},agent.lr:{low:1.0e-4,high:1.0e-2}}",
]


TRACKING_PASSWORD = "not-for-anybody"


def processes_with(texts):
    """Return the command lines of this machine's processes that contain one of the texts."""
    found = []
    for words in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            line = words.read_bytes().replace(b"\0", b" ").decode(errors="replace")
            found += [line for text in texts if text in line]
    return found


@contextlib.contextmanager
def watched(look):
    """Poll `look` during the block; yield the list of what was seen."""
    seen, is_over = [], threading.Event()

    def watch():
        while not is_over.wait(0.05):
            seen.extend(look())

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield seen
    finally:
        is_over.set()
        thread.join()


@pytest.mark.parametrize("is_local", [False, True], ids=["environment", "local-file"])
def test_study_on_services_shows_their_passwords_nowhere(postgres, tracking_server, tmp_path, is_local):
    storage_uri = postgres.make_database()
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "XDG_CONFIG_HOME": str(tmp_path / "mine")}
    environment |= {"MLFLOW_TRACKING_USERNAME": "me", "MLFLOW_TRACKING_PASSWORD": TRACKING_PASSWORD}
    if is_local:
        # The database's password is in the file that PGPASSFILE names.
        (tmp_path / "mine" / "armscan").mkdir(parents=True)
        local = {"storage": storage_uri, "tracking_uri": tracking_server.uri}
        (tmp_path / "mine" / "armscan" / "services.yaml").write_text(json.dumps(local))
    else:
        environment |= {"ARMSCAN_STORAGE": storage_uri, "MLFLOW_TRACKING_URI": tracking_server.uri}
        environment |= {STORAGE_PASSWORD: PASSWORD, "PGPASSFILE": os.devnull}
    with watched(lambda: processes_with((PASSWORD, TRACKING_PASSWORD))) as seen:
        ended = subprocess.run(
            [sys.executable, "-m", "armscan.run", *WORDS, "+cluster=postgres", f"tracking.experiment=local-{is_local}"],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    assert len(re.findall(r"\ntrial \d+ done", ended.stdout)) == 2
    assert seen == []
    study = optuna.load_study(study_name="sac_y", storage=open_storage(storage_uri).optuna)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 2
    client = MlflowClient(tracking_server.uri)
    runs = client.search_runs([client.get_experiment_by_name(f"local-{is_local}").experiment_id])
    # The study's own, and one of each trial.
    assert [run.info.status for run in runs] == ["FINISHED"] * 3
    files = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert {"multirun.yaml", "worker-0.log", *(f"{run.info.run_id}.jsonl" for run in runs)} <= {f.name for f in files}
    shown = [ended.stdout, *(str(run.to_dictionary()) for run in runs)]
    shown += [repr((trial.user_attrs, trial.system_attrs)) for trial in study.trials]
    shown += [
        repr((study.user_attrs, study._storage.get_study_system_attrs(study._study_id))),
        tracking_server.log.read_text(),
    ]
    for password in (PASSWORD, TRACKING_PASSWORD):
        assert not [text for text in shown if password in text]
        assert [file for file in files if password.encode() in file.read_bytes()] == []


def test_address_with_a_password_is_refused_where_it_would_be_shown(answer, tmp_path):
    for word in ("study.storage=postgresql://me:secret@host/db", "tracking.uri=http://me:secret@host"):
        code, told = answer("-m", "sweep=sac_y", word)
        assert code == 2
        assert f"{word.partition('=')[0]} has a password in its address, where others could read it: " in told
        assert "secret" not in told
    (tmp_path / "tracking").mkdir()
    (tmp_path / "tracking" / "mine.yaml").write_text(
        "{uri: 'http://me:secret@host', experiment: a, artifacts: b, wait_s: 1.0}"
    )
    for words in ([], ["-m"], ["-m", "sweep=sac_y"]):
        code, told = answer(*words, "tracking=mine", f"hydra.searchpath=[{tmp_path}]")
        assert code == 2
        assert "tracking.uri has a password in its address" in told
        assert told.count("\n") == 0
        assert "secret" not in told
    assert [path.name for path in tmp_path.iterdir()] == ["tracking"]


def test_address_uses_psycopg_and_the_password_of_the_environment(monkeypatch):
    monkeypatch.setenv(STORAGE_PASSWORD, "a:b@c")
    assert database_url("postgresql://me@host/db", STORAGE_PASSWORD).render_as_string(hide_password=False) == (
        "postgresql+psycopg://me:a%3Ab%40c@host/db"
    )
    assert database_url("sqlite:///a.db", STORAGE_PASSWORD).password is None


def test_study_in_postgresql_without_psycopg_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(StudyError, match=r"but psycopg is not installed: pip install 'armscan\[postgres\]'"):
        open_storage("postgresql://me@127.0.0.1:1/db")

"""`armscan ui` as a person uses it: started, looked at in a browser, ended in every way."""

import json
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import urllib.request
from contextlib import closing
from pathlib import Path

import optuna
import pytest
from mlflow import MlflowClient

from armscan.cli.main import main
from armscan.config.credentials import STORAGE_PASSWORD, TRACKING_PASSWORD, database_url
from armscan.sweeps.storage.database import tables_in
from armscan.sweeps.storage.storage import open_storage
from armscan.ui import servers
from armscan.ui.servers import HOST
from armscan.ui.show import newest_tested
from tests.support import FEW_VOLUMES
from tests.support.ports import free_ports
from tests.support.postgres import PASSWORD
from tests.support.processes import processes_in, start_run
from tests.support.waiting import wait_until

SMALL = [
    *("-m", "sweep=sac_y", "study.name=small", "study.n_trials=3", "study.workers=1", "study.final_eval.top_k=0"),
    *("study/pruner=none", *FEW_VOLUMES, "training.env_steps=600"),
    *("training.eval_every_env_steps=200", "training.validation_episodes=2", "env.max_steps=8", "agent.batch_size=32"),
    *("agent.learning_starts=100", "network.vector.hidden_sizes=[16]"),
]
TRAINING = "sac-cluster-y-phantom-seed0"
END_S = 60
PROGRAM = (sys.executable, "-m", "armscan", "ui")
PORT_OPTIONS = ("--mlflow-port", "--dashboard-port")


def make_study(uri):
    study = optuna.create_study(study_name="a", storage=open_storage(uri).optuna, load_if_exists=True)
    study.optimize(lambda trial: trial.suggest_float("x", 0, 1), n_trials=2)


def make_experiment(uri):
    MlflowClient(tracking_uri=uri).create_experiment("mine")


def answer_of(address):
    with urllib.request.urlopen(address, timeout=30) as answer:
        return answer.read().decode()


def studies_at(address):
    return [each["study_name"] for each in json.loads(answer_of(f"{address}/api/studies"))["study_summaries"]]


def experiments_at(address):
    return {each.name for each in MlflowClient(tracking_uri=address).search_experiments()}


class Look:
    """The command as a person starts it, with ports of its own; ready when it says how to end it."""

    def __init__(self, folder, *words, **environment):
        self.folder, self.file = folder, folder / "printed"
        mlflow_port, dashboard_port = free_ports(2)
        self.mlflow, self.dashboard = f"http://{HOST}:{mlflow_port}", f"http://{HOST}:{dashboard_port}"
        words = [*words, f"--dashboard-port={dashboard_port}", f"--mlflow-port={mlflow_port}"]
        self.process = start_run(*words, cwd=folder, command=PROGRAM, environment=environment)
        wait_until(lambda: "Ctrl-C ends" in self.printed or self.process.poll() is not None)

    @property
    def printed(self):
        return self.file.read_text()

    @property
    def servers(self):
        return [pid for pid in processes_in(self.folder) if pid != self.process.pid]

    def end(self, number=signal.SIGINT):
        self.process.send_signal(number)
        return self.process.wait(END_S)


@pytest.fixture
def look():
    looks = []

    def start(*words, **environment):
        looks.append(Look(*words, **environment))
        return looks[-1]

    yield start
    for each in looks:
        each.process.kill()
        each.process.wait()
        wait_until(lambda folder=each.folder: processes_in(folder) == [])


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """Return a folder with a study and an experiment in the usual places."""
    folder = tmp_path_factory.mktemp("both")
    make_study(str(folder / "optuna.journal"))
    make_experiment(f"sqlite:///{folder}/mlruns.db")
    return folder


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--study=a"], "No such option '--study'."),
        (["storage"], "Got unexpected extra argument (storage)"),
        (["--storage="], "Invalid value for '--storage': an address is required."),
        (["--mlflow-port=0"], "Invalid value for '--mlflow-port': 0 is not in the range 1<=x<=65535."),
        (["--dashboard-port=65536"], "Invalid value for '--dashboard-port': 65536 is not in the range 1<=x<=65535."),
        (["--dashboard-port=http"], "Invalid value for '--dashboard-port': 'http' is not a valid integer"),
        (["--storage=nowhere/a.journal"], "--storage is 'nowhere/a.journal', but there are no studies there"),
        (["--storage=sqlite:///nowhere.db"], "--storage is 'sqlite:///nowhere.db', but there are no studies there"),
        (
            ["--storage=mysql://me@there/db"],
            "--storage is 'mysql://me@there/db', but it must be a file, sqlite:///FILE",
        ),
        (["--storage=other"], "--storage is '{here}/other', but that file is not an Optuna journal"),
        (["--tracking=sqlite:///nowhere.db"], "--tracking is 'sqlite:///nowhere.db', but there are no runs there"),
        (
            ["--tracking=sqlite:///other"],
            "--tracking is 'sqlite:///other', but this store cannot be used: file is not a",
        ),
        (["--tracking=./mlruns"], "--tracking is './mlruns', but it must be sqlite:///FILE, postgresql://... or an"),
        (
            ["--tracking=postgresql://me@127.0.0.1:1/db"],
            "--tracking is 'postgresql://me@127.0.0.1:1/db', but this store cannot be used: ",
        ),
        (
            ["--tracking=postgresql://me@there:port/db"],
            "--tracking is 'postgresql://me@there:port/db', but this store cannot",
        ),
        ([], "there is nothing to look at, no studies in 'optuna.journal' and no runs in 'sqlite:///mlruns.db': give"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_ui_answers_mistakes_in_one_line_and_makes_nothing(tmp_path, monkeypatch, capsys, words, line):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "other").write_text("not what is looked for\n" * 100)
    assert main(["ui", *words]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"error: {line.format(here=tmp_path)}")
    assert printed.err.count("\n") == 1
    assert PASSWORD not in printed.err
    assert printed.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["other"]


@pytest.mark.parametrize("option", PORT_OPTIONS)
def test_ui_names_a_port_that_is_taken_and_starts_nothing(both, monkeypatch, capsys, option):
    monkeypatch.chdir(both)
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        others = [f"{other}={free}" for other, free in zip(PORT_OPTIONS, free_ports(2), strict=True) if other != option]
        assert main(["ui", f"{option}={port}", *others]) == 2
    printed = capsys.readouterr()
    assert printed.err == f"error: {option} is {port}, but {HOST}:{port} cannot be used (address already in use)\n"
    assert printed.out == ""
    assert processes_in(both) == [os.getpid()]


def test_page_of_the_last_study_with_a_result_is_found(tmp_path):
    storage = open_storage(str(tmp_path / "optuna.journal"))
    for name in ("a", "a-selection", "a-judged", "b", "b-selection", "b-judged", "c", "c-selection", "c-judged"):
        study = optuna.create_study(study_name=name, storage=storage.optuna)
        if name == "a":
            assert newest_tested(storage) is None
        # A study that has begun has an empty test.
        if name in ("a-judged", "b-judged"):
            attributes = {"judged": -1, "judged_seed": 2000, "figures": {}}
            study.add_trial(optuna.trial.create_trial(value=1.0, user_attrs=attributes))
    assert newest_tested(storage) == ("b", 3)


def test_ui_shows_what_is_there_until_it_is_interrupted(both, look):
    looked = look(both)
    assert looked.printed.splitlines()[-3:] == [
        f"studies   {looked.dashboard}",
        f"runs      {looked.mlflow}/#/experiments",
        "Ctrl-C ends both",
    ]
    assert studies_at(looked.dashboard) == ["a"]
    assert "mine" in experiments_at(looked.mlflow)
    assert looked.end() == 130
    assert looked.printed.endswith("Ctrl-C ends both\n\ninterrupted\n")
    wait_until(lambda: processes_in(both) == [])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_ui_takes_its_servers_along_when_it_is_killed(both, look, number):
    looked = look(both)
    assert len(looked.servers) == 2
    assert looked.end(number) == -number
    wait_until(lambda: processes_in(both) == [])


def test_ui_ends_and_says_so_when_mlflow_ends_by_itself(both, look):
    looked = look(both)
    (server,) = [pid for pid in looked.servers if "serve_mlflow" in Path(f"/proc/{pid}/cmdline").read_text()]
    os.kill(server, signal.SIGKILL)
    assert looked.process.wait(END_S) == 2
    said = looked.printed.partition("Ctrl-C ends both\n")[2]
    assert said.endswith("error: MLflow has ended by itself, with exit code -9; the end of its log is above\n")
    assert "Traceback" not in said
    wait_until(lambda: processes_in(both) == [])


def test_ui_shows_the_end_of_the_log_of_a_server_that_cannot_start(both, tmp_path, look):
    shutil.copy(both / "mlruns.db", tmp_path)
    with closing(sqlite3.connect(tmp_path / "mlruns.db")) as database, database:
        database.execute("UPDATE alembic_version SET version_num = '451aebb31d03'")
    looked = look(tmp_path)
    assert looked.process.wait(END_S) == 2
    log, error, _ = looked.printed.partition("error: MLflow has ended by itself, with exit code 1; the end of its log")
    assert error
    assert "out-of-date database schema" in log


def test_ui_tells_of_a_server_that_does_not_answer_in_time(both, monkeypatch, capsys):
    monkeypatch.chdir(both)
    monkeypatch.setattr(servers, "START_S", 0.0)
    assert main(["ui", *(f"{option}={port}" for option, port in zip(PORT_OPTIONS, free_ports(2), strict=True))]) == 2
    assert capsys.readouterr().err.endswith(
        "error: MLflow does not answer within 0 s of its start; the end of its log is above\n"
    )
    wait_until(lambda: processes_in(both) == [os.getpid()])


@pytest.mark.parametrize(
    ("missing", "note"),
    [
        ("optuna.journal", "there are no studies in 'optuna.journal' yet; --storage URI names others"),
        ("mlruns.db", "there are no runs in 'sqlite:///mlruns.db' yet; --tracking URI names others"),
    ],
)
def test_ui_shows_the_one_that_is_there_and_says_that_the_other_is_not(both, tmp_path, look, missing, note):
    for file in {"optuna.journal", "mlruns.db"} - {missing}:
        shutil.copy(both / file, tmp_path)
    looked = look(tmp_path)
    lines = looked.printed.splitlines()
    assert lines[0] == f"note: {note}"
    assert lines[1].startswith("starting  ")
    assert len(lines) == 4
    assert lines[-1] == "Ctrl-C ends it"
    assert looked.end() == 130
    assert not (tmp_path / missing).exists()


@pytest.mark.parametrize(("storage", "study_id"), [("{}/a.journal", 0), ("sqlite:///{}/a.db", 1)])
def test_dashboard_shows_trials_that_come_later(tmp_path, look, storage, study_id):
    def n_trials():
        return len(json.loads(answer_of(f"{looked.dashboard}/api/studies/{study_id}"))["trials"])

    uri = storage.format(tmp_path)
    make_study(uri)
    looked = look(tmp_path, f"--storage={uri}")
    assert n_trials() == 2
    make_study(uri)
    wait_until(lambda: n_trials() == 4)


def test_ui_leaves_runs_to_the_server_that_keeps_them(both, look):
    # The server is named on the command line; the environment holds its password.
    looked = look(both, "--tracking=http://127.0.0.1:1", MLFLOW_TRACKING_PASSWORD=PASSWORD)
    assert looked.printed.splitlines() == [
        "starting  Optuna's dashboard, which takes some seconds",
        "runs      http://127.0.0.1:1",
        f"studies   {looked.dashboard}",
        "Ctrl-C ends it",
    ]
    assert looked.servers == []


def test_ui_shows_what_is_in_postgresql_and_no_password(postgres, tmp_path, look, monkeypatch, capsys):
    storage, tracking, empty = (postgres.make_database() for _ in range(3))
    make_study(storage)
    make_experiment(tracking.replace("postgresql://", "postgresql+psycopg://"))
    words = [f"--{key}={uri}" for key, uri in {"storage": storage, "tracking": tracking}.items()]
    looked = look(tmp_path, *words, **{STORAGE_PASSWORD: PASSWORD, TRACKING_PASSWORD: PASSWORD})
    assert "Ctrl-C ends both" in looked.printed
    assert studies_at(looked.dashboard) == ["a"]
    assert "mine" in experiments_at(looked.mlflow)
    assert all(PASSWORD not in Path(f"/proc/{pid}/cmdline").read_text() for pid in processes_in(tmp_path))
    assert looked.end() == 130
    assert PASSWORD not in looked.printed
    assert [path.name for path in tmp_path.iterdir()] == ["printed"]
    monkeypatch.setenv(TRACKING_PASSWORD, PASSWORD)
    assert main(["ui", f"--tracking={empty}"]) == 2
    assert "there are no runs there" in capsys.readouterr().err
    assert tables_in(database_url(empty, STORAGE_PASSWORD)) == []


@pytest.fixture
def small_study(tmp_path):
    """Return a folder in which a person has run a study."""
    words = [sys.executable, "-m", "armscan.run", *SMALL]
    ended = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return tmp_path


def test_ui_shows_a_study_in_the_browser(small_study, look, browser):
    pictures = Path(os.environ.get("ARMSCAN_SCREENSHOTS", small_study / "screenshots")).absolute()
    looked = look(small_study)
    study = optuna.load_study(study_name="small", storage=open_storage(str(small_study / "optuna.journal")).optuna)

    browser.open(looked.dashboard)
    browser.click("*", text="0. small")
    # The points of its history.
    browser.count(".scatterlayer .points path", at_least=3)
    browser.keep(pictures / "study.png")
    browser.click("a[href$='/trials']")
    for trial in study.trials:
        browser.find("span", text=f"Trial {trial.number}")
    browser.click("span", text="Trial 1")
    browser.find("h1, h2, h3, h4, h5, h6", text="Trial 1 (trial_id=1)")
    assert browser.picture("img[alt='learning_curve.png']") > 0
    browser.keep(pictures / "trial.png")
    # The figures of its seed, and no row of JSON.
    browser.find("td", text="steps, mean")
    assert not browser.has("td", text="lease")
    # The link leads to its run, at the port of this MLflow.
    browser.open(browser.find("a", text="its run in MLflow").get_attribute("href"))
    browser.find("h1, h2, h3", text="small-0001")
    assert browser.address.startswith(f"{looked.mlflow}/#/")
    assert study.trials[1].user_attrs["mlflow_run"] in browser.address

    (page,) = [line.split()[1] for line in looked.printed.splitlines() if line.startswith("runs ")]
    browser.open(page)
    browser.find("a", text="study small")
    # A column of the saved view, with a metric of the best trial.
    browser.find("[col-id='metrics.`validation/on_plane_5mm_10deg`']")
    assert not browser.has("a", text="small-0001")
    # The button that shows the children of a run.
    browser.click("[data-component-id*='runnamecellrenderer']")
    for trial in study.trials:
        browser.find("a", text=f"small-000{trial.number}")
    browser.keep(pictures / "runs.png")
    browser.click("a", text="small-0001")
    browser.find("h1, h2, h3", text="small-0001")
    # Its parent and its child.
    browser.find("a", text="study small")
    browser.click("a", text=TRAINING)
    browser.find("h1, h2, h3", text=TRAINING)
    browser.click("[role=tab]", text="Model metrics")
    browser.type("input[placeholder='Search metric charts']", "mean_steps")
    # A line between two points.
    browser.count("path.js-line[d*='L']", at_least=1)
    browser.keep(pictures / "metric.png")
    browser.click("[role=tab]", text="Artifacts")
    browser.click("*", text="learning_curve.png")
    assert browser.picture("img[src^='blob:']") > 0
    browser.keep(pictures / "artifact.png")
    assert looked.end() == 130

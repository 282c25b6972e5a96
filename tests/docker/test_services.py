"""Every service's command from the compose file, run on this machine with its health check."""

import json
import os
import shlex
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path

import psycopg
import pytest
from mlflow import MlflowClient

from armscan.utils.processes import EXIT_INTERRUPTED
from tests.docker.containers import SECRETS, Containers
from tests.docker.files import FOLDER
from tests.docker.image import ImageContainers, built_image
from tests.support.postgres import PASSWORD, postgres_server
from tests.support.waiting import HANG_S, wait_until

SECRET = f"{SECRETS}/database_password"
# Trials that only wait, between one and five seconds, with only one searched key.
TRIALS = (
    "study.task._target_=benchmarks.sweeps.sleeping.Sleeping study/pruner=none "
    "study.n_trials=2 study.final_eval.top_k=0 "
    "agent.gamma=0.5 agent.utd_ratio=0.1 agent.batch_size=64 'study.space.agent.lr={low: 0.001, high: 0.01}'"
)
# Trials that train; the benchmarks are not in the image.
TRAININGS = (
    "study/pruner=none study.n_trials=2 study.final_eval.top_k=0 training.env_steps=3000 "
    "training.validation_episodes=2 data.n_training=1 data.n_validation=1 data.n_test=1 evaluation.episodes=2"
)
# Database connections of a worker, which leave room for others: see POSTGRES_CONNECTIONS.
MAX_CONNECTIONS = 6


@pytest.fixture
def postgres_there(postgres_programs):
    """Yield a server for this test alone."""
    with postgres_server() as server:
        yield server


@pytest.fixture(scope="module")
def image():
    """Yield the built image."""
    with built_image() as buildah:
        yield buildah


@pytest.fixture(params=["processes", pytest.param("image", marks=pytest.mark.slow)])
def containers(request, postgres_programs, postgres_there, tmp_path):
    """Yield the services on this machine; PostgreSQL is running, as its image leaves it at its first start."""
    given = (tmp_path, postgres_there.port, postgres_programs, PASSWORD)
    reached = {"MLFLOW_HOSTS": "there:5000,localhost:*", "MLFLOW_ORIGINS": "http://there:5000"}
    if request.param == "image":
        services = ImageContainers(request.getfixturevalue("image"), *given, **reached, ARMSCAN_WORDS=TRAININGS)
    else:
        services = Containers(*given, **reached, ARMSCAN_WORDS=TRIALS)
    postgres_there.execute(f"CREATE DATABASE {services.services['postgres']['environment']['POSTGRES_DB']}")
    postgres_there.execute((FOLDER / "databases.sql").read_text())
    try:
        yield services
    finally:
        services.stop_all()


def asked(url, posted=None, **headers):
    """Return the status and the body of an answer."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, posted, headers), timeout=HANG_S) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def command_lines(marked):
    """Return the command lines of all processes that have this in their environment."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if marked.encode() in (process / "environ").read_bytes():
                found.append((process / "cmdline").read_bytes())
    return found


def selected(server, query):
    """Return the first column of a query's result in the studies' database."""
    with psycopg.connect(server.uri("armscan")) as connection:
        return [row[0] for row in connection.execute(query)]


def states(server):
    """Return the states of the trials."""
    return selected(server, "SELECT state::text FROM trials ORDER BY number")


def n_connections(server):
    """Return the number of clients of the studies' database, except this one."""
    (n_all,) = selected(server, "SELECT count(*) FROM pg_stat_activity WHERE datname = 'armscan'")
    return n_all - 1


@pytest.mark.parametrize("containers", ["processes"], indirect=True)
def test_postgres_understands_its_words_and_says_when_it_is_unavailable(containers, postgres_there, postgres_programs):
    words = shlex.split(containers.services["postgres"]["command"])
    (data,) = selected(postgres_there, "SHOW data_directory")
    # The value that these arguments would give, printed without a start.
    asking = [postgres_programs / words[0], "-C", "max_connections", *words[1:], "-D", data]
    said = subprocess.run(asking, capture_output=True, text=True, check=True)
    assert int(said.stdout) >= 300
    assert containers.is_healthy("postgres")
    postgres_there.stop()
    assert not containers.is_healthy("postgres")


@pytest.mark.slow
def test_study_on_the_services_is_stopped_and_gone_on_with(containers, postgres_there):
    for name in ("mlflow", "dashboard"):
        assert not containers.is_healthy(name)
        containers.start(name)
    for name in ("mlflow", "dashboard"):
        containers.wait_until_healthy(name)
    mlflow, dashboard = (f"http://127.0.0.1:{containers.ports[name]}" for name in ("mlflow", "dashboard"))
    # By the name that other services use, as a browser does, and as a foreign page would.
    asked_for = {"mlflow": f"{mlflow}/ajax-api/2.0/mlflow/experiments/search?max_results=1"}
    asked_for["dashboard"] = f"{dashboard}/api/studies"
    for name, url in asked_for.items():
        for host, status in ((name, 200), ("localhost", 200), ("elsewhere", 403)):
            assert asked(url, Host=f"{host}:{containers.ports[name]}")[0] == status, (name, host)
    # MLflow's pages search by POST.
    there = f"there:{containers.ports['mlflow']}"
    search = asked_for["mlflow"].partition("?")[0], b'{"max_results": 1}'
    for origin, status in (
        (f"http://{there}", 200),
        (f"http://localhost:{containers.ports['mlflow']}", 200),
        ("http://a", 403),
    ):
        headers = {"Host": there, "Origin": origin, "Content-Type": "application/json"}
        assert asked(*search, **headers)[0] == status, origin

    n_before = n_connections(postgres_there)
    assert not containers.is_healthy("worker")
    containers.start("worker")
    containers.wait_until_healthy("worker")
    # Until the trial knows its tracked run, which is then resumed.
    wait_until(lambda: "mlflow_run" in selected(postgres_there, "SELECT key FROM trial_user_attributes"))
    assert states(postgres_there) == ["RUNNING"]
    assert n_connections(postgres_there) - n_before <= MAX_CONNECTIONS
    words = command_lines(f"ARMSCAN_STORAGE_PASSWORD_FILE={containers.here(SECRET)}")
    assert len(words) >= 5
    assert [each for each in words if PASSWORD.encode() in each] == []
    assert containers.stop("worker") == EXIT_INTERRUPTED, containers.log("worker")
    assert states(postgres_there) == ["WAITING"]
    assert not containers.is_healthy("worker")

    assert containers.start("worker").wait(HANG_S) == 0, containers.log("worker")
    assert states(postgres_there) == ["COMPLETE"] * 2
    shown = json.loads(asked(f"{dashboard}/api/studies")[1])
    assert [study["study_name"] for study in shown["study_summaries"]] == ["sac_y"]
    client = MlflowClient(mlflow)
    (experiment,) = (each for each in client.search_experiments() if each.name == "armscan")
    runs = client.search_runs([experiment.experiment_id])
    # The runs of the study and its trials; trainings also have runs of the baselines.
    assert len(runs) >= 3
    assert {run.info.status for run in runs} == {"FINISHED"}
    client.log_text(runs[0].info.run_id, "kept", "note.txt")
    assert [file.read_text() for file in containers.folder.glob("artifacts/**/note.txt")] == ["kept"]
    assert {each.name for each in containers.folder.glob("work/*")} >= {"studies", "optuna.artifacts"}
    assert PASSWORD not in "".join(containers.log(name) for name in ("mlflow", "dashboard", "worker"))
    assert containers.is_healthy("mlflow")
    postgres_there.stop()
    assert not containers.is_healthy("mlflow")


def test_entry_refuses_a_password_that_cannot_be_read(tmp_path):
    ended = subprocess.run(
        [FOLDER / "entry.sh", "true"],
        env={"PATH": os.environ["PATH"], "ARMSCAN_STORAGE_PASSWORD_FILE": str(tmp_path / "not-there")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode != 0
    assert "not-there" in ended.stderr


@pytest.mark.parametrize("variable", ["ARMSCAN_STORAGE_PASSWORD", "ARMSCAN_STORAGE_PASSWORD_FILE"])
def test_entry_hands_the_password_to_every_client_of_the_database(variable, tmp_path):
    (tmp_path / "password").write_text("a b'$c\n")
    value = str(tmp_path / "password") if variable.endswith("FILE") else "a b'$c"
    words = [FOLDER / "entry.sh", sys.executable, "-c", "import os; print(os.environ['PGPASSWORD'])"]
    ended = subprocess.run(words, env={"PATH": os.environ["PATH"], variable: value}, capture_output=True, check=True)
    assert ended.stdout == b"a b'$c\n"

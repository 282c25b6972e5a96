"""Studies whose workers are tasks of a real Ray cluster of two machines, one of which dies."""

import pytest

from armscan.config.credentials import STORAGE_PASSWORD
from tests.cluster.studies import TRAINING, WAITING
from tests.support import REPOSITORY
from tests.support.mlflow_server import mlflow_server
from tests.support.postgres import PASSWORD, postgres_server
from tests.support.ray_cluster import ray_cluster, why_not_here
from tests.support.requirements import unavailable


@pytest.fixture(scope="module")
def cluster():
    """Start a cluster, and enter its first machine for all that follows."""
    if (reason := why_not_here()) is not None:
        unavailable(reason)
    with (
        ray_cluster({"PYTHONPATH": str(REPOSITORY), STORAGE_PASSWORD: PASSWORD}) as started,
        started.head.entered(),
    ):
        yield started


@pytest.fixture(scope="module")
def postgres(postgres_programs, cluster):
    with postgres_server(cluster.head.address) as server:
        yield server


@pytest.fixture(scope="module")
def tracking_server(cluster, postgres, tmp_path_factory):
    with mlflow_server(tmp_path_factory.mktemp("mlflow"), postgres.make_database(), cluster.head.address) as server:
        yield server


def test_study_that_is_told_to_end_hands_its_trials_back(cluster, start):
    words = ["study.workers=2", "study.n_trials=50", "study.final_eval.top_k=0"]
    study = start(*WAITING, "hydra/launcher=ray", *words, environment=cluster.environment)
    study.holder(0)
    study.holder(1)
    # Ray handles this signal itself.
    study.process.terminate()
    assert study.end() == 130, study.told()
    printed = study.printed.read_text()
    assert printed.endswith("interrupted; the same command resumes the study\n")
    assert "SIGTERM" not in printed
    assert {trial.state.name for trial in study.trials()} <= {"COMPLETE", "WAITING"}
    assert {run.info.status for run in study.runs()} <= {"FINISHED", "KILLED"}


@pytest.mark.slow
def test_study_outlives_a_killed_worker_and_a_machine_that_is_gone(cluster, start):
    words = ["study.workers=2", "study.n_trials=3", "study.final_eval.top_k=0", "training.env_steps=8000"]
    study = start(*TRAINING, "hydra/launcher=ray", *words, environment=cluster.environment)
    numbers = {study.holder(number)["host"]: number for number in (0, 1)}
    assert numbers.keys() == {cluster.head.name, cluster.other.name}
    study.kill_worker(numbers[cluster.head.name])
    study.holder(numbers[cluster.other.name])
    cluster.other.crash()
    assert study.end() == 0, study.told()
    study.check_complete(3)
    study.check_secret()
    lost = [trial.user_attrs["failure"] for trial in study.trials() if trial.state.name == "FAIL"]
    assert sorted(reason.rpartition(" on ")[2] for reason in lost) == sorted(numbers)
    # Ray has restarted the other worker on the machine that is left.
    assert study.worker(numbers[cluster.other.name])["host"] == cluster.head.name

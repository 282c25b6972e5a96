"""A study whose PostgreSQL and MLflow servers are unavailable for a while in the middle of it."""

import contextlib
import time

import optuna
import pytest
from mlflow import MlflowClient

from armscan.sweeps.storage.attribute_names import RETRY_OF
from armscan.sweeps.storage.storage import open_storage
from tests.support import FEW_VOLUMES, REPOSITORY
from tests.support.mlflow_server import mlflow_server
from tests.support.postgres import postgres_server
from tests.support.processes import start_run
from tests.support.waiting import HANG_S, wait_until

# A real, short training of four seconds or more, with a report after each epoch.
TRAINING = [
    *(
        "training.env_steps=3600",
        "training.eval_every_env_steps=200",
        "training.validation_episodes=4",
        "study/pruner=none",
    ),
    *(*FEW_VOLUMES, "agent.learning_starts=1000"),
    *("study.workers=1", "study.final_eval.top_k=0", "study.prune_after_env_steps=100"),
]


@pytest.fixture
def services(postgres_programs, tmp_path):
    """Yield a PostgreSQL server, and an MLflow server that keeps its runs in another."""
    with (
        postgres_server() as postgres,
        postgres_server() as of_runs,
        mlflow_server(tmp_path / "server", of_runs.make_database()) as server,
    ):
        yield postgres, server


@contextlib.contextmanager
def study(folder, storage_uri, tracking_uri, *words):
    """Yield a study as a user starts it; end it in any case."""
    environment = {"ARMSCAN_STORAGE": storage_uri, "MLFLOW_TRACKING_URI": tracking_uri, "PYTHONPATH": str(REPOSITORY)}
    folder.mkdir()
    given = ["-m", "sweep=sac_y", "+cluster=postgres", *TRAINING, *words]
    process = start_run(*given, cwd=folder, environment=environment)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait()


def worker_log(folder):
    logs = list(folder.glob("studies/sac_y/workers/*/worker-0.log"))
    return logs[0].read_text() if logs else ""


def wait_for(is_so, process, folder):
    wait_until(is_so, process=process, log=lambda: (folder / "printed").read_text() + worker_log(folder))


def has_begun(folder, seed_folder):
    return (folder / "studies" / "sac_y" / "trials" / seed_folder / "last.pt").exists()


def assert_complete(storage_uri, tracking_uri, n_trials):
    """Check that all trials have finished, none twice, and that MLflow has all of them."""
    trials = optuna.load_study(study_name="sac_y", storage=open_storage(storage_uri).optuna).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * n_trials
    assert not [trial for trial in trials if RETRY_OF in trial.user_attrs]
    client = MlflowClient(tracking_uri)
    runs = client.search_runs([client.get_experiment_by_name("armscan").experiment_id])
    # The run of the study, and for each trial its own and that of its seed.
    assert [run.info.status for run in runs] == ["FINISHED"] * (1 + 2 * n_trials)
    of_seeds = [run for run in runs if "config.sha256" in run.data.tags and "volumes.training" in run.data.tags]
    assert len(of_seeds) == n_trials
    for run in of_seeds:
        steps = [point.step for point in client.get_metric_history(run.info.run_id, "validation/mean_steps")]
        # After each epoch of 200 steps, from the 1,000 random ones on; none is missing and none is there twice.
        assert steps == sorted(set(steps))
        assert (steps[-1], len(steps)) == (3600, 13)
        assert {"best.pt", "learning_curve.png"} <= {file.path for file in client.list_artifacts(run.info.run_id)}


@pytest.mark.parametrize("away_s", [6.0, pytest.param(30.0, marks=pytest.mark.slow)], ids=lambda away_s: f"{away_s:g}s")
def test_study_loses_nothing_while_its_services_are_unavailable(services, tmp_path, away_s):
    postgres, server = services
    folder, storage_uri = tmp_path / "here", postgres.make_database()
    with study(folder, storage_uri, server.uri, "study.n_trials=2") as process:
        # In the middle of the first training.
        wait_for(lambda: has_begun(folder, "0000/seed_0"), process, folder)
        server.stop()
        time.sleep(away_s)
        server.start()
        # In the middle of the second, and then at the end of its run.
        wait_for(lambda: has_begun(folder, "0001/seed_0"), process, folder)
        postgres.restart(away_s=2.0)
        wait_for(lambda: not has_begun(folder, "0001/seed_0"), process, folder)
        server.stop()
        time.sleep(away_s)
        server.start()
        assert process.wait(HANG_S) == 0, (folder / "printed").read_text()
    assert_complete(storage_uri, server.uri, 2)
    log = worker_log(folder)
    assert log.count("the storage is unavailable") == log.count("the storage is back") == 1
    # Once for each run that was open.
    said = [line.partition("  ")[2] for line in log.splitlines() if "cannot be reached or written to" in line]
    assert 1 <= len(said) == len(set(said)) <= 4

"""Measure what one more worker costs PostgreSQL and MLflow.

    python -m benchmarks.sweeps.scaling [--tracking] [--workers 1 2 4]

Workers run trials that only report ten times, one after another. They are threads in a few processes and compose no
configuration, since that needs neither service; all else is as in a study. Without `--tracking`, runs are not tracked,
and only the storage is measured.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock

import optuna
from omegaconf import DictConfig, OmegaConf

from armscan.sweeps.scheduling.limits import Limits
from armscan.sweeps.scheduling.scheduler import TrialScheduler
from armscan.sweeps.space.space import Space
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.phase import Phase
from armscan.sweeps.tasks.attempt import Attempt
from armscan.sweeps.workers import worker as worker_module
from armscan.sweeps.workers.heartbeat import Heartbeat
from armscan.sweeps.workers.worker import Worker
from armscan.tracking import open_store
from armscan.utils.retry import RetryPolicy
from benchmarks.arguments import count, parser_of, run_script
from benchmarks.tables import print_head, print_row
from tests.support.mlflow_server import mlflow_server
from tests.support.postgres import PostgresServer, postgres_server

WORKERS = (1, 2, 4, 8, 16, 32)
N_REPORTS, STEPS_A_REPORT = 10, 100
MAX_PROCESSES, TRIALS_A_WORKER, MIN_TRIALS = 4, 10, 120
SPACE = {"agent.lr": {"low": 1e-4, "high": 1e-2, "log": True}, "agent.batch_size": {"choices": [64, 128, 256]}}
SAMPLER = {"_target_": "optuna.samplers.RandomSampler"}
SETTINGS = {"shared_preload_libraries": "pg_stat_statements", "max_connections": "400"}
# Statements and commits of each database, and its busy seconds, which exclude waiting for the lock of a study.
CALLS = """
SELECT datname, sum(calls), sum(calls) FILTER (WHERE query ILIKE 'commit%'),
    sum(total_exec_time) FILTER (WHERE query NOT ILIKE '%advisory%') / 1000
FROM pg_stat_statements JOIN pg_database ON pg_database.oid = dbid GROUP BY datname
"""


class Asked(NamedTuple):
    """Statements and transactions of a database.

    Args:
        statements: Number of statements.
        commits: Number of commits.
        busy_s: Seconds that the database spent on the statements.
    """

    statements: int
    commits: int
    busy_s: float


class NoStore:
    """A tracking store that accepts everything and keeps nothing."""

    uri, wait_s, system_metrics_s = "nowhere", 5.0, None

    def __init__(self) -> None:
        self.mlflow = self

    def create_run(self, *_: Any, **__: Any) -> Any:
        """Return a run that is not stored."""
        return SimpleNamespace(info=SimpleNamespace(run_id=uuid.uuid4().hex))

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None


def reporting(attempt: Attempt) -> dict[str, float]:
    """Report as a trial does, and do nothing else."""
    for part in range(1, N_REPORTS + 1):
        attempt.report(
            {"mean_steps": 1.0 / part},
            seed=0,
            n_env_steps=part * STEPS_A_REPORT,
            report_every_env_steps=STEPS_A_REPORT,
            total_env_steps=N_REPORTS * STEPS_A_REPORT,
        )
    return {"mean_steps": 1.0}


def compose_run(words: object) -> tuple[DictConfig, dict[str, str]]:
    """Return a fixed configuration instead of composing one."""
    return OmegaConf.create({"seed": 0}), {}


def phase_of(storage_uri: str, tracking_uri: str | None, folder: Path, n_trials: int) -> Phase:
    """Open the study as a worker does; its trials only report."""
    storage = open_storage(storage_uri)
    study = optuna.create_study(study_name="scaling", storage=storage.optuna, load_if_exists=True)
    store: Any = NoStore()
    experiment_id = "0"
    if tracking_uri is not None:
        store, experiment_id = open_store(tracking_uri, experiment="scaling", artifacts="-", wait_s=60.0)
    return Phase(
        name="scaling",
        scheduler=TrialScheduler(study, storage, Limits(n_trials=n_trials)),
        space=Space.read(SPACE),
        objectives=("mean_steps",),
        reported=("mean_steps",),
        run=reporting,
        seeds_of=lambda _: (0,),
        sampler=SAMPLER,
        seed=0,
        folder=folder,
        artifacts=folder / "artifacts",
        store=store,
        experiment_id=experiment_id,
        run_id="study",
    )


@contextmanager
def round_trips_counted() -> Iterator[dict[int, int]]:
    """Count the storage calls of each thread, by its ID."""
    counts: dict[int, int] = {}
    call = RetryPolicy.call

    def counted(policy: RetryPolicy, operate: Any) -> Any:
        here = threading.get_ident()
        counts[here] = counts.get(here, 0) + 1
        return call(policy, operate)

    with mock.patch.object(RetryPolicy, "call", counted):
        yield counts


def work(phase: Phase, name: str) -> None:
    """Run a worker as its process does."""
    heartbeat = Heartbeat(
        phase.scheduler, name, should_leave=lambda: False, leave=lambda: None, on_death=lambda _: None
    )
    with heartbeat.running():
        Worker(phase, [], heartbeat).work()


def work_in_threads(n_threads: int, number: int, barrier: Any, opened: partial[Phase]) -> None:
    """Run some of the workers in this process, once the workers of all processes are ready."""
    worker_module.compose_run = compose_run
    worker_module.log = lambda text: None
    phases = [opened() for _ in range(n_threads)]
    threads = [threading.Thread(target=work, args=(phase, f"{number}-{i}")) for i, phase in enumerate(phases)]
    barrier.wait()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def asked(server: PostgresServer, uri: str) -> Asked:
    """Return the statements and transactions of a database since its counts were reset."""
    of_database = {name: rest for name, *rest in server.execute(CALLS)}
    statements, commits, busy_s = of_database.get(uri.rpartition("/")[2], (0, 0, 0.0))
    return Asked(int(statements), int(commits or 0), float(busy_s))


def measured(server: PostgresServer, n_workers: int, tracking_uri: str | None, folder: Path) -> tuple[float, int, str]:
    """Run a study; return its seconds, its number of trials, and the URI of its database."""
    n_trials = max(MIN_TRIALS, TRIALS_A_WORKER * n_workers)
    uri = server.make_database()
    opened = partial(phase_of, uri, tracking_uri, folder, n_trials)
    opened()
    n_processes = min(MAX_PROCESSES, n_workers)
    shares = [n_workers // n_processes + (i < n_workers % n_processes) for i in range(n_processes)]
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(n_processes + 1)
    processes = [context.Process(target=work_in_threads, args=(n, i, barrier, opened)) for i, n in enumerate(shares)]
    for process in processes:
        process.start()
    barrier.wait()
    server.execute("SELECT pg_stat_statements_reset()")
    for process in processes:
        process.join()
    # From the start of the first trial to the end of the last, without the time in which processes exit.
    trials = opened().scheduler.study.get_trials(deepcopy=False)
    took = max(each.datetime_complete for each in trials) - min(each.datetime_start for each in trials)
    return took.total_seconds(), n_trials, uri


def row(took_s: float, n_trials: int, of_storage: Asked, of_mlflow: Asked | None) -> list[str]:
    """Return the cells of a study in the table."""
    figures = [f"{60 * n_trials / took_s:.0f}", f"{of_storage.commits / n_trials:.1f}"]
    for each in (of_storage, of_mlflow):
        figures += [f"{each.statements / n_trials:.0f}", f"{each.busy_s / took_s:.1%}"] if each else ["-", "-"]
    return figures


def main() -> None:
    """Print a row for each number of workers."""
    parser = parser_of(__doc__)
    parser.add_argument("--tracking", action="store_true")
    parser.add_argument("--workers", type=count, nargs="+", default=WORKERS)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, postgres_server(**SETTINGS) as server:
        server.execute("CREATE EXTENSION pg_stat_statements")
        backend = server.make_database()
        tracking = mlflow_server(Path(name), backend) if given.tracking else nullcontext()
        of_storage = "transactions", "statements", "busy"
        print_head("workers", "trials/min", *of_storage, "MLflow: statements", "busy")
        with tracking as mlflow:
            for n_workers in given.workers:
                tracking_uri = mlflow.uri if mlflow else None
                took_s, n_trials, uri = measured(server, n_workers, tracking_uri, Path(name) / str(n_workers))
                of_mlflow = asked(server, backend) if mlflow else None
                print_row(n_workers, *row(took_s, n_trials, asked(server, uri), of_mlflow))


if __name__ == "__main__":
    run_script(main)

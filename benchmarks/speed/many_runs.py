"""Processor and wall seconds of `armscan report` and `runs list` in a store of many runs.

    python -m benchmarks.speed.many_runs [--runs N] [--epochs N] [--before CHECKOUT]

The runs are copies of a real, short one: its parameters, tags, metrics and files, with learning curves of this many
epochs (default: 200 runs, 20 epochs). They are read from a SQLite file and through an MLflow server on it. With
`--before`, each process of this checkout follows one of the other, whose figures stand beside it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from mlflow import MlflowClient
from mlflow.entities import Metric, Param, RunTag

from benchmarks.arguments import count
from benchmarks.repository import REPOSITORY
from benchmarks.speed.checkouts import comparing_parser_of, run_timed
from benchmarks.tables import print_head, print_row
from tests.support.mlflow_server import mlflow_server

SMALL = (
    "training.env_steps=2000",
    "training.eval_every_env_steps=500",
    "evaluation.episodes=40",
    "env.max_steps=10",
    "agent.learning_starts=500",
)
COMMANDS = {
    "`report --runs experiment:many`": ("report", "--runs", "experiment:many", "--out", "report"),
    "`runs list`": ("runs", "list", "--experiment", "many"),
}
AT_ONCE = 1000


def armscan(checkout: Path, folder: Path, *words: str, uri: str) -> tuple[float, float]:
    """Return the processor seconds of a command, and its wall seconds."""
    return run_timed(checkout, folder, "-m", "armscan", *words, MLFLOW_TRACKING_URI=uri)[1:]


def copy_run(client: MlflowClient, folder: Path, *, n_runs: int, n_epochs: int) -> None:
    """Copy the only run of a store into another experiment, with three seeds of each configuration."""
    (run,) = client.search_runs(["1"])
    experiment_id = client.create_experiment("many", artifact_location=(folder / "many").as_uri())
    files = Path(client.download_artifacts(run.info.run_id, "", str(folder / "files")))
    curves = {name for name in run.data.metrics if len(client.get_metric_history(run.info.run_id, name)) > 1}
    points = [
        Metric(name, value, epoch, 1000 * epoch)
        for name, value in run.data.metrics.items()
        for epoch in range(1, n_epochs + 1 if name in curves else 2)
    ]
    kept = {"config.yaml", "volumes.json", "evaluation.json", "baselines.json", "episode.gif"}
    for number in range(n_runs):
        changed = {"seed": str(number % 3), "agent.batch_size": str(number // 3 + 64)}
        tags = [RunTag(*each) for each in run.data.tags.items()]
        made = client.create_run(experiment_id, run_name=f"{run.info.run_name}-{number}").info.run_id
        for first in range(0, len(points), AT_ONCE):
            client.log_batch(made, metrics=points[first : first + AT_ONCE])
        params = [Param(*each) for each in ({**run.data.params} | changed).items()]
        for first in range(0, len(params), 100):
            client.log_batch(made, params=params[first : first + 100], tags=tags if first == 0 else ())
        for name in kept:
            if (files / name).is_file():
                client.log_artifact(made, str(files / name))
        client.set_terminated(made)


def main() -> None:
    """Print the table."""
    parser = comparing_parser_of(__doc__)
    parser.add_argument("--runs", type=count, default=200, help="runs in the store (default: 200)")
    parser.add_argument("--epochs", type=count, default=20, help="epochs of each (default: 20)")
    given = parser.parse_args()
    checkouts = {**({"before": given.before} if given.before else {}), "now": REPOSITORY}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        uri = f"sqlite:///{folder}/mlruns.db"
        armscan(REPOSITORY, folder, "run", *SMALL, uri=uri)
        copy_run(MlflowClient(uri), folder, n_runs=given.runs, n_epochs=given.epochs)
        columns = (f"{name}, {seconds} s" for seconds in ("processor", "wall") for name in checkouts)
        print_head(f"{given.runs} runs", *columns, align="---:")
        with mlflow_server(folder / "server", uri) as server:
            for store, address in {"SQLite": uri, "a server": server.uri}.items():
                for command, words in COMMANDS.items():
                    both = (armscan(checkout, folder, *words, uri=address) for checkout in checkouts.values())
                    seconds = (each for measured in zip(*both, strict=True) for each in measured)
                    print_row(f"{command}, {store}", *(f"{each:.1f}" for each in seconds))


if __name__ == "__main__":
    main()

"""Runs of `armscan.run` for benchmarks, and their results.

A run that has finished is not repeated: its folder is read again. Delete the folder to repeat the run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mlflow import MlflowClient

from armscan.errors import InvalidValueError
from armscan.tracking import open_store

# Trains on a folder and on phantoms; validates and tests on phantoms alone.
MIXED = ("data=mixed", "data.validation=phantoms", "data.test=phantoms")
CURVE = ("train/length", "train/length_max", "train/return", "train/return_min", "wall_s")


@dataclass(frozen=True)
class Run:
    """A finished run.

    Args:
        folder: Folder of the run.
        store: Address of its tracking store.
    """

    folder: Path
    store: str

    @cached_property
    def evaluations(self) -> dict[str, dict]:
        """Figures and episodes of the final evaluations, by the name of their volumes."""
        return json.loads((self.folder / "evaluation.json").read_text())

    @cached_property
    def curve(self) -> dict[str, list[tuple[int, float]]]:
        """(environment step, value) pairs of each metric of `CURVE`; none for agents that do not learn."""
        client = MlflowClient(self.store)
        run_id = (self.folder / "run_id").read_text()
        return {
            name: sorted((metric.step, metric.value) for metric in client.get_metric_history(run_id, name))
            for name in CURVE
        }

    @property
    def training_s(self) -> float:
        """Seconds of learning and validating."""
        return max((value for _, value in self.curve["wall_s"]), default=0.0)

    @property
    def n_env_steps(self) -> int:
        """Environment steps of the training."""
        return max((step for step, _ in self.curve["wall_s"]), default=0)


def add_folder(parser: argparse.ArgumentParser) -> None:
    """Add the option `--folder`, the folder of the runs."""
    default = Path("benchmark-runs")
    parser.add_argument("--folder", type=Path, default=default, help="folder of the runs (default: %(default)s)")


def finished_run(name: str, overrides: Sequence[str], folder: Path) -> Run:
    """Run `armscan.run` with the overrides, unless a run of that name has finished in the folder already.

    Raises:
        InvalidValueError: That run had other overrides, such as other volumes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    run_folder, command_file = folder / name, folder / f"{name}.overrides"
    store = f"sqlite:///{folder.absolute()}/mlruns.db"
    if (run_folder / "run_id").exists():
        if (before := command_file.read_text().split("\n")) != [*overrides]:
            raise InvalidValueError(f"{run_folder} is a run with {before}, not with {[*overrides]}: delete it first")
    else:
        command_file.write_text("\n".join(overrides))
        command = [
            *(sys.executable, "-m", "armscan.run", *overrides),
            *(f"hydra.run.dir={run_folder.absolute()}", f"tracking.uri={store}", f"tracking.experiment={name}"),
            f"tracking.artifacts={folder.absolute()}/mlartifacts",
        ]
        print(f"{name}: python -m armscan.run {' '.join(overrides)}", flush=True)
        with (folder / f"{name}.log").open("w") as log:
            subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=True)
        client, experiment_id = open_store(
            store, experiment=name, artifacts=f"{folder.absolute()}/mlartifacts", wait_s=60.0
        )
        (newest,) = client.search_runs([experiment_id], order_by=["attributes.start_time DESC"], max_results=1)
        (run_folder / "run_id").write_text(newest.info.run_id)
    return Run(run_folder, store)

"""A run that was tracked, found again: its configuration and its checkpoint."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from mlflow import MlflowClient
from mlflow.entities import Run

from armscan.errors import InvalidValueError, TrackingError, listed
from armscan.files import BEST_CHECKPOINT
from armscan.tracking.run import CONFIG_FILE
from armscan.tracking.store import SQLITE_PREFIX, usable_store

# What a run's agent was trained on, as `armscan.training.Familiar` writes it.
FAMILIAR_TAG = "trained_on"
# Which run an evaluation is of; only evaluations have it.
EVALUATED_TAG = "evaluation.of"
SHORTEST_PREFIX, ID_LENGTH = 4, 32
MOST_RUNS_NAMED = 5


@dataclass(frozen=True)
class FoundRun:
    """A run in the store.

    Args:
        client: of the store.
        uri: of the store.
        experiment_id: that the run is in.
        run_id: of the run.
        name: what the UI calls it.
        status: how it ended, or that it is RUNNING.
        tags: of the run.
        files: its artifacts, by their paths.
    """

    client: MlflowClient = field(repr=False)
    uri: str
    experiment_id: str
    run_id: str
    name: str
    status: str
    tags: dict[str, str] = field(repr=False)
    files: tuple[str, ...]

    def config(self, folder: Path) -> dict[str, Any]:
        """Returns the resolved configuration; `folder` takes the file.

        Raises:
            TrackingError: if the run has kept none, or it is damaged.
        """
        try:
            config = yaml.safe_load(self._fetched(CONFIG_FILE, folder).read_text())
        except (UnicodeDecodeError, yaml.YAMLError) as error:
            raise TrackingError(f"run {self.run_id}: its {CONFIG_FILE} is damaged") from error
        if not isinstance(config, dict):
            raise TrackingError(f"run {self.run_id}: its {CONFIG_FILE} holds no configuration")
        return config

    def checkpoint(self, folder: Path) -> Path | None:
        """Returns the best checkpoint, fetched into `folder`; None where the run has kept none."""
        return self._fetched(BEST_CHECKPOINT, folder) if BEST_CHECKPOINT in self.files else None

    def _fetched(self, file: str, folder: Path) -> Path:
        if file not in self.files:
            raise TrackingError(
                f"run {self.run_id} has kept no {file}: it is {self.status}, and only a run that has come to its "
                "end can be evaluated"
            )
        with usable_store(self.uri):
            return Path(self.client.download_artifacts(self.run_id, file, str(folder)))


def find_run(uri: str, run_id: str) -> FoundRun:
    """Returns a tracked run.

    Args:
        uri: of the store.
        run_id: the run's id, or the first four or more characters of it if no other run's begins so.

    Raises:
        InvalidValueError: if it cannot be an id, or no run has it, or several have.
        TrackingError: if the store does not exist or cannot be used.
    """
    if not re.fullmatch(rf"[0-9a-f]{{{SHORTEST_PREFIX},{ID_LENGTH}}}", run_id):
        raise InvalidValueError(
            f"run is {run_id!r}, but it must be the id of a run, or at least its first {SHORTEST_PREFIX} characters "
            "(of 0 to 9 and a to f), as the UI shows it"
        )
    is_file = uri.startswith(SQLITE_PREFIX)
    database = Path(uri.removeprefix(SQLITE_PREFIX)).absolute()
    if is_file and not database.is_file():
        raise TrackingError(
            f"tracking is {uri!r}, but there is no such file: go to the folder that the runs were started in, or give "
            "tracking=URI"
        )
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    with usable_store(uri):
        # MLflow remembers stores by these, wherever a relative one leads by then.
        client = MlflowClient(tracking_uri=f"{SQLITE_PREFIX}{database}" if is_file else uri)
        experiments = [experiment.experiment_id for experiment in client.search_experiments()]
        found = client.search_runs(experiments, f"attributes.run_id LIKE '{run_id}%'", max_results=MOST_RUNS_NAMED)
        if len(found) == 1:
            return _found(client, uri, found[0])
    if found:
        raise InvalidValueError(f"run is {run_id!r}, but several runs begin so: {listed(r.info.run_id for r in found)}")
    raise InvalidValueError(f"run is {run_id!r}, but {uri} holds no run whose id begins so")


def _found(client: MlflowClient, uri: str, run: Run) -> FoundRun:
    return FoundRun(
        client=client,
        uri=uri,
        experiment_id=run.info.experiment_id,
        run_id=run.info.run_id,
        name=run.info.run_name,
        status=run.info.status,
        tags=dict(run.data.tags),
        files=tuple(artifact.path for artifact in client.list_artifacts(run.info.run_id)),
    )

"""One tracked run: parameters, learning curves, evaluations and artifacts in MLflow."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mlflow import MlflowClient
from mlflow.entities import Metric, Param

from armscan.errors import is_interruption
from armscan.tracking.pictures import draw_learning_curve
from armscan.tracking.source import source_tags
from armscan.training import EpochReport, Evaluation, TrainingResult

EVALUATION_FILE, CURVE_FILE = "evaluation.json", "learning_curve.png"
PARAMS_A_BATCH = 100
MAX_PARAM_CHARS = 6000


class TrackedRun:
    """A run in MLflow, and the training callback that fills it.

    Args:
        client: of an open store.
        run_id: of the run.
        name: what the UI calls the run.
        logged: the names and steps of the figures that are there already, which are not logged again.
    """

    def __init__(
        self, client: MlflowClient, run_id: str, *, name: str, logged: Collection[tuple[str, int]] = ()
    ) -> None:
        self._client = client
        self._logged = frozenset(logged)
        self.run_id = run_id
        self.name = name

    @classmethod
    def start(
        cls,
        client: MlflowClient,
        experiment_id: str,
        *,
        name: str,
        config: Mapping[str, Any],
        tags: Mapping[str, str],
        parent_id: str | None = None,
    ) -> Self:
        """Makes a new run.

        Args:
            client: of an open store.
            experiment_id: of the run.
            name: what the UI calls the run.
            config: the resolved configuration; its leaves become parameters.
            tags: further tags.
            parent_id: the run that this one is a child of, None for none.
        """
        parent = {"mlflow.parentRunId": parent_id} if parent_id else {}
        run = client.create_run(experiment_id, run_name=name, tags={**source_tags(), **tags, **parent})
        tracked = cls(client, run.info.run_id, name=name)
        tracked.log_config(config)
        return tracked

    @classmethod
    def go_on(cls, client: MlflowClient, run_id: str, *, config: Mapping[str, Any], tags: Mapping[str, str]) -> Self:
        """Opens a run again that was interrupted, as if nothing had happened to it.

        Args:
            client: of the run's store.
            run_id: of the run.
            config: as it was started with; parameters that were not logged any more are.
            tags: to set anew.
        """
        run = client.get_run(run_id)
        if "failure" in run.data.tags:
            client.delete_tag(run_id, "failure")
        code = {f"resumed.{key}": value for key, value in source_tags().items() if key.startswith("git.")}
        resumed = {"resumed": str(int(run.data.tags.get("resumed", "0")) + 1)}
        client.update_run(run_id, status="RUNNING")
        logged = {(name, point.step) for name in run.data.metrics for point in client.get_metric_history(run_id, name)}
        tracked = cls(client, run_id, name=run.info.run_name or run_id, logged=logged)
        tracked.set_tags(dict(tags) | code | resumed)
        tracked.log_config(config)
        return tracked

    def set_tags(self, tags: Mapping[str, str]) -> None:
        """Sets tags."""
        for key, value in tags.items():
            self._client.set_tag(self.run_id, key, value)

    def log_config(self, config: Mapping[str, Any]) -> None:
        """Logs a configuration's leaves as parameters; those that are there already stay as they are."""
        params = [Param(key, str(value)[:MAX_PARAM_CHARS]) for key, value in flattened(config).items()]
        for first in range(0, len(params), PARAMS_A_BATCH):
            self._client.log_batch(self.run_id, params=params[first : first + PARAMS_A_BATCH])

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Makes up for what was not logged any more when the run was killed."""
        for report in earlier:
            self.on_epoch(report)

    def on_epoch(self, report: EpochReport) -> None:
        """Logs an epoch's figures by environment step."""
        figures = {f"validation/{name}": value for name, value in report.evaluation.metrics().items()}
        figures |= report.metrics | {"wall_s": report.wall_s}
        self.log_figures(figures, n_env_steps=report.n_env_steps)

    def on_end(self) -> None:
        """The run goes on: evaluation and artifacts come after the training."""

    def log_figures(self, figures: Mapping[str, float], *, n_env_steps: int) -> None:
        """Logs figures at an environment step, in one request; none twice."""
        now_ms = time.time_ns() // 1_000_000
        metrics = [
            Metric(name, value, now_ms, n_env_steps)
            for name, value in figures.items()
            # MLflow has no place for a mean over no episodes, which is NaN.
            if value == value and (name, n_env_steps) not in self._logged
        ]
        if metrics:
            self._client.log_batch(self.run_id, metrics=metrics)

    def log_files(self, *files: Path) -> None:
        """Keeps files as artifacts."""
        for file in files:
            self._client.log_artifact(self.run_id, str(file))

    def keep_results(self, result: TrainingResult | None, evaluations: Mapping[str, Evaluation], folder: Path) -> None:
        """Logs the final evaluations, and keeps what the run has made in its folder.

        Args:
            result: of the training; the evaluations are logged at the step of its best epoch, whose weights they judge.
                None where there was nothing to learn.
            evaluations: by the name of their volumes.
            folder: of the run; the learning curve's picture and the evaluations' figures are added to it.
        """
        for name, evaluation in evaluations.items():
            prefix = name.replace(" ", "_").replace("-", "_")
            figures = {f"{prefix}/{figure}": value for figure, value in evaluation.metrics().items()}
            self.log_figures(figures, n_env_steps=result.best.n_env_steps if result else 0)
        if result:
            self.log_figures({"best_env_step": result.best.n_env_steps}, n_env_steps=result.reports[-1].n_env_steps)
            draw_learning_curve(result.reports, folder / CURVE_FILE, title=self.name)
        contents = {name: evaluation.to_dict() for name, evaluation in evaluations.items()}
        (folder / EVALUATION_FILE).write_text(json.dumps(contents, indent=1))
        self.log_files(*sorted(file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the run: FINISHED, KILLED where it was interrupted, FAILED after any other error."""
        if error is None:
            self.end("FINISHED")
        elif is_interruption(error):
            self.end("KILLED", reason="interrupted")
        else:
            self.end("FAILED", reason=repr(error))

    def end(self, status: str, *, reason: str | None = None) -> None:
        """Closes the run as FINISHED, FAILED (with the reason) or KILLED."""
        if reason is not None:
            self._client.set_tag(self.run_id, "failure", reason[:MAX_PARAM_CHARS])
        self._client.set_terminated(self.run_id, status)


def flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns the leaves of nested mappings by their dotted keys; lists are leaves, written as JSON."""
    leaves: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            leaves |= flattened(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = json.dumps(value) if isinstance(value, list | dict) else value
    return leaves

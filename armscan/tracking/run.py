"""One tracked run: parameters, learning curves, evaluations and artifacts in MLflow."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml
from mlflow import MlflowClient
from mlflow.entities import Metric, Param

from armscan.errors import is_interruption
from armscan.tracking.pictures import draw_learning_curve
from armscan.tracking.source import source_tags
from armscan.training import EpochReport, Evaluation, TrainingResult

CONFIG_FILE, EVALUATION_FILE, CURVE_FILE = "config.yaml", "evaluation.json", "learning_curve.png"
PARAMS_A_BATCH = 100
MAX_PARAM_CHARS = 6000


class TrackedRun:
    """A run in MLflow, and the training callback that fills it.

    Args:
        client: of an open store.
        experiment_id: of the run.
        name: what the UI calls the run.
        config: the resolved configuration; its leaves become parameters.
        tags: further tags.
        parent_id: the run that this one is a child of, None for none.
    """

    def __init__(
        self,
        client: MlflowClient,
        experiment_id: str,
        *,
        name: str,
        config: Mapping[str, Any],
        tags: Mapping[str, str],
        parent_id: str | None = None,
    ) -> None:
        self._client = client
        self._config = dict(config)
        self.name = name
        parent = {"mlflow.parentRunId": parent_id} if parent_id else {}
        run = client.create_run(experiment_id, run_name=name, tags={**source_tags(), **tags, **parent})
        self.run_id: str = run.info.run_id
        params = [Param(key, str(value)[:MAX_PARAM_CHARS]) for key, value in flattened(config).items()]
        for first in range(0, len(params), PARAMS_A_BATCH):
            client.log_batch(self.run_id, params=params[first : first + PARAMS_A_BATCH])

    def on_start(self, total_env_steps: int) -> None:
        """Nothing is known yet."""

    def on_epoch(self, report: EpochReport) -> None:
        """Logs an epoch's figures by environment step."""
        figures = {f"validation/{name}": value for name, value in report.evaluation.metrics().items()}
        figures |= report.metrics | {"wall_s": report.wall_s}
        self.log_figures(figures, n_env_steps=report.n_env_steps)

    def on_end(self) -> None:
        """The run goes on: evaluation and artifacts come after the training."""

    def log_figures(self, figures: Mapping[str, float], *, n_env_steps: int) -> None:
        """Logs figures at an environment step, in one request."""
        now_ms = time.time_ns() // 1_000_000
        # MLflow has no place for a mean over no episodes.
        metrics = [Metric(name, value, now_ms, n_env_steps) for name, value in figures.items() if value == value]
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
        (folder / CONFIG_FILE).write_text(yaml.safe_dump(self._config, sort_keys=False))
        self.log_files(*sorted(file for file in folder.iterdir() if file.is_file()))

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

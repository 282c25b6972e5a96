"""The best checkpoint of a run as an MLflow `LoggedModel`, with its settings and its metrics by dataset."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from armscan.tracking.tags import CHOICE
from armscan.utils.log import log
from armscan.utils.run_files import BEST_CHECKPOINT

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import LoggedModel, Metric, Run

MODEL_TYPE = "policy"
# MLflow's own tag, by which its UI links a model to its registered versions.
VERSIONS_TAG = "mlflow.modelVersions"
CONTEXT_TAG = "mlflow.data.context"
PARAMS = ("projection", "seed")
# Characters that MLflow refuses in a model name.
REFUSED = re.compile(r"[/:.%\"']")
# Error code of a server that does not have logged models yet.
UNKNOWN = "ENDPOINT_NOT_FOUND"


def upload_model(client: MlflowClient, run_id: str, step: int, metrics: Mapping[str, Sequence[str]]) -> None:
    """Create the model of a run's best checkpoint, or complete an existing one.

    Args:
        client: Client of the run's store.
        run_id: MLflow run ID.
        step: Environment step of the checkpoint; the run's metrics at this step become the model's.
        metrics: Names of these metrics, by the split (validation, test) that they were measured on.
    """
    from mlflow.entities import LoggedModelOutput
    from mlflow.exceptions import MlflowException

    run = client.get_run(run_id)
    try:
        model = model_of(client, run) or _made(client, run, step)
    except MlflowException as error:
        if error.error_code != UNKNOWN:
            raise
        log(f"run {run_id}: this server keeps no models of checkpoints (MLflow below 3)")
        return
    if model.model_id not in [each.model_id for each in (run.outputs.model_outputs if run.outputs else ())]:
        client.log_outputs(run_id, [LoggedModelOutput(model.model_id, step)])
    client.log_batch(run_id, metrics=list(_metrics(client, run, model.model_id, step, metrics)))
    client.finalize_logged_model(model.model_id, "READY")


def model_of(client: MlflowClient, run: Run) -> LoggedModel | None:
    """Return the model of a run's best checkpoint; None if it has none."""
    found = client.search_logged_models([run.info.experiment_id], f"source_run_id = '{run.info.run_id}'")
    model: LoggedModel | None = next(iter(found), None)
    return model


def _made(client: MlflowClient, run: Run, step: int) -> LoggedModel:
    tags, params = run.data.tags, run.data.params
    chosen = {tag.removeprefix(CHOICE): value for tag, value in tags.items() if tag.startswith(CHOICE)}
    model: LoggedModel = client.create_logged_model(
        run.info.experiment_id,
        name=REFUSED.sub("-", run.info.run_name or "") or run.info.run_id,
        source_run_id=run.info.run_id,
        tags={"checkpoint": f"runs:/{run.info.run_id}/{BEST_CHECKPOINT}"},
        params={**chosen, **{name: params[name] for name in PARAMS if name in params}, "env_steps": str(step)},
        model_type=MODEL_TYPE,
    )
    return model


def _metrics(
    client: MlflowClient, run: Run, model_id: str, step: int, metrics: Mapping[str, Sequence[str]]
) -> Iterator[Metric]:
    """Yield metrics of the run as those of its model; they equal the run's own, which therefore do not change."""
    from mlflow.entities import Metric

    datasets: dict[str, Any] = {
        tag.value: each.dataset
        for each in (run.inputs.dataset_inputs if run.inputs else ())
        for tag in each.tags
        if tag.key == CONTEXT_TAG
    }
    for part, names in metrics.items():
        dataset = datasets.get(part)
        of_dataset = {"dataset_name": dataset.name, "dataset_digest": dataset.digest} if dataset else {}
        for name in names:
            points = [each for each in client.get_metric_history(run.info.run_id, name) if each.step == step]
            for point in points[-1:]:
                where = {"model_id": model_id, "run_id": run.info.run_id, **of_dataset}
                yield Metric(name, point.value, point.timestamp, step, **where)

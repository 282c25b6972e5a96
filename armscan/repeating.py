"""`python -m armscan.run -m ... resume=true`: a grid is repeated, but what has finished of it is not run again.

A job's earlier run is known by its configuration and its volumes, which both have to be the same to the last value.
"""

from __future__ import annotations

from pathlib import Path

from mlflow.entities import Run
from omegaconf import DictConfig

from armscan.building import check_keys
from armscan.experiment import run_experiment
from armscan.files import LAST_CHECKPOINT
from armscan.invocation import Invocation
from armscan.multirun import JOB_TAG, Job
from armscan.provenance import started_with, sum_tags
from armscan.resume import go_on
from armscan.settings import plain
from armscan.stage import Stage
from armscan.tracking import TrackingStore, open_store
from armscan.training import TEST, TRAINING

Figures = dict[str, dict[str, float]]


def run_again(config: DictConfig, invocation: Invocation, job: Job) -> Figures:
    """Returns the figures of a job's earlier run, goes on with it where it was cut off, or runs the job.

    Args:
        config: of the job.
        invocation: how it was asked for.
        job: the job.
    """
    check_keys(config)
    stage, tracking = Stage.built(config), plain(config.tracking)
    client, experiment_id = open_store(**tracking)
    earlier = _earlier_runs(client, experiment_id, stage, config)
    for run in earlier:
        if run.info.status == "FINISHED":
            print(f"[{job.label}] has finished before: run {run.info.run_id}", flush=True)
            _adopt(client, run, job)
            return _figures_of(run)
    for run in earlier:
        if run.info.status != "RUNNING" and (Path(run.data.tags["folder"]) / LAST_CHECKPOINT).exists():
            _adopt(client, run, job)
            return go_on(client, run.info.run_id, job_label=job.label)
    return run_experiment(config, invocation)


def _earlier_runs(client: TrackingStore, experiment_id: str, stage: Stage, config: DictConfig) -> list[Run]:
    """Returns the runs of this configuration on these volumes, the latest first."""
    sums = sum_tags(started_with(plain(config), stage))
    wanted = " and ".join(f"tags.`{tag}` = '{value}'" for tag, value in sums.items())
    return list(client.search_runs([experiment_id], wanted, order_by=["attributes.start_time DESC"]))


def _adopt(client: TrackingStore, run: Run, job: Job) -> None:
    """Makes a run a child of the grid that is repeated."""
    client.set_tag(run.info.run_id, "mlflow.parentRunId", job.parent_run_id)
    client.set_tag(run.info.run_id, JOB_TAG, str(job.number))


def _figures_of(run: Run) -> Figures:
    prefixes = {name: f"{name.replace(' ', '_')}/" for name in (TRAINING, TEST)}
    return {
        name: {key.removeprefix(prefix): value for key, value in run.data.metrics.items() if key.startswith(prefix)}
        for name, prefix in prefixes.items()
    }

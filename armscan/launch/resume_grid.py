"""`armscan run resume=ID` of a grid: repeat it without the jobs that have finished.

A job's earlier run is found by the checksums of its configuration and its volumes.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from armscan.config.defaults import to_plain
from armscan.experiment.build import check_keys, set_up
from armscan.experiment.job import Invocation, Job
from armscan.experiment.provenance import provenance_files, sha256_tags
from armscan.experiment.results import LAST_VALIDATION, figures_of
from armscan.experiment.resume import resume_run
from armscan.experiment.runner import run_experiment
from armscan.tracking import TrackingStore, open_store
from armscan.tracking.tags import FOLDER_TAG, JOB_TAG, PARENT_TAG
from armscan.utils.files import LAST_CHECKPOINT

if TYPE_CHECKING:
    from mlflow.entities import Run

Metrics = dict[str, dict[str, float]]


def run_again(config: DictConfig, invocation: Invocation, job: Job) -> Metrics:
    """Return the metrics of a job's finished run; resume an interrupted one, or run the job."""
    check_keys(config)
    setup, tracking = set_up(config), to_plain(config.tracking)
    client, experiment_id = open_store(**tracking)
    # Runs of this configuration on these volumes, the latest first.
    sums = sha256_tags(provenance_files(to_plain(config), setup))
    wanted = " and ".join(f"tags.`{tag}` = '{value}'" for tag, value in sums.items())
    earlier = client.search_runs([experiment_id], wanted, order_by=["attributes.start_time DESC"])
    for run in earlier:
        if run.info.status == "FINISHED":
            print(f"[{job.label}] has finished before: run {run.info.run_id}", flush=True)
            _set_parent(client, run, job)
            return _metrics_of(run)
    for run in earlier:
        folder = run.data.tags.get(FOLDER_TAG)
        if run.info.status != "RUNNING" and folder is not None and (Path(folder) / LAST_CHECKPOINT).exists():
            _set_parent(client, run, job)
            # Trusted, because its configuration is this job's.
            return resume_run(client, run.info.run_id, job_label=job.label, trust=True)
    return run_experiment(config, invocation)


def _set_parent(client: TrackingStore, run: Run, job: Job) -> None:
    """Make a run a child of the grid that is repeated."""
    client.set_tag(run.info.run_id, PARENT_TAG, job.parent_run_id)
    client.set_tag(run.info.run_id, JOB_TAG, str(job.number))


def _metrics_of(run: Run) -> Metrics:
    return {
        name: figures.metrics() for name, figures in figures_of(run.data.metrics).items() if name != LAST_VALIDATION
    }

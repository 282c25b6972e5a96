"""The best job of a grid, whose figures the grid's own run shows in MLflow."""

from __future__ import annotations

from collections.abc import Sequence

from mlflow.entities import Metric, Param, Run, RunTag

from armscan.config.task import have_same_task
from armscan.stats.on_plane import ON_PLANE_KEY, leading_of
from armscan.tracking import TrackingStore
from armscan.tracking.outbox import now_ms
from armscan.tracking.tags import BEST_TAG
from armscan.training.baselines import RANDOM
from armscan.training.episode_results import TEST_METRICS
from armscan.training.metric_display import leading_among

TESTED = f"{TEST_METRICS}/"


def best_job(runs: Sequence[Run]) -> Run | None:
    """Return the run with the highest leading on-plane rate on its test volumes.

    None if no run was evaluated, or their leading rates are within different limits.
    """
    rates = {f"{TESTED}{leading_of(run.data.params).metric}" for run in runs}
    if len(rates) != 1:
        return None
    (rate,) = rates
    evaluated = [run for run in runs if rate in run.data.metrics]
    return max(evaluated, key=lambda run: float(run.data.metrics[rate]), default=None)


def log_best(store: TrackingStore, parent_id: str, jobs: Sequence[Run]) -> None:
    """Log the leading figures of a grid's best job, and of random planes, to the grid's run, by the same names.

    If jobs have different tasks or test volumes, only the limits of an on-plane rate are logged.

    Args:
        store: Tracking store of the grid.
        parent_id: MLflow run ID of the grid.
        jobs: Runs of its jobs.
    """
    if (best := best_job(jobs)) is None:
        return
    limits = [Param(name, value) for name, value in best.data.params.items() if name == ON_PLANE_KEY]
    if not have_same_task(job.data.params for job in jobs):
        store.log_batch(parent_id, params=limits)
        return
    now, metrics = now_ms(), []
    for group in (TESTED, f"{RANDOM}/"):
        found = {name.removeprefix(group): value for name, value in best.data.metrics.items() if name.startswith(group)}
        metrics += [Metric(f"{group}{name}", found[name], now, 0) for name in leading_among(found)]
    store.log_batch(parent_id, metrics=metrics, params=limits, tags=[RunTag(BEST_TAG, best.info.run_id)])

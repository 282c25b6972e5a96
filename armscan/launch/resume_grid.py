"""`armscan run resume=ID` of a grid: repeat it without the jobs that have finished.

A job's earlier run is found by the checksums of its configuration and its volumes. The new grid takes it over.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from armscan.config.defaults import FOLD, to_plain
from armscan.config.own_code import changed_modules
from armscan.config.task import is_under
from armscan.config.trust import check_composed
from armscan.errors import ArmscanError, TrackingError
from armscan.experiment.build import check_keys, set_up
from armscan.experiment.job import Invocation, Job
from armscan.experiment.provenance import provenance_files, sha256_tags
from armscan.experiment.results import LAST_VALIDATION, figures_of
from armscan.experiment.resume import check_own_code, resume_run
from armscan.experiment.runner import run_experiment
from armscan.launch.resume import grid_overrides
from armscan.tracking import TrackingStore, load_run, open_store, sync
from armscan.tracking.sanitize import params_of
from armscan.tracking.tags import FOLDER_TAG, JOB_TAG, OWN_CODE_TAG, PARENT_TAG, STUDY_TAG
from armscan.training import Fingerprints, check_unchanged
from armscan.utils.run_files import LAST_CHECKPOINT, folder_lock

if TYPE_CHECKING:
    from mlflow.entities import Run

Metrics = dict[str, dict[str, float]]


def run_again(config: DictConfig, invocation: Invocation, job: Job) -> Metrics:
    """Return the metrics of a job's finished run; resume an interrupted one, or run the job."""
    check_keys(config)
    resolved = to_plain(config)
    if not job.grid.is_trusted:
        check_composed(resolved, where=f"job {job.number}")
    setup = set_up(config)
    store, experiment_id = open_store(**resolved["tracking"])
    earlier = earlier_runs(store, experiment_id, sha256_tags(provenance_files(resolved, setup)), job)
    if not any(run.data.tags.get(PARENT_TAG) == job.grid.repeats for run in earlier):
        _check_volumes(store, experiment_id, params_of(resolved), setup.fingerprints, job)
    for run in earlier:
        if run.data.tags.get(PARENT_TAG) == job.grid.repeats:
            check_own_code(run, setup)
    # Of other grids, and single runs.
    earlier = [run for run in earlier if not changed_modules(run.data.tags.get(OWN_CODE_TAG), setup.own_code)]
    for run in earlier:
        if run.info.status == "FINISHED":
            print(f"[{job.label}] has finished before: run {run.info.run_id}", flush=True)
            _set_parent(store, run, job)
            return _metrics_of(run)
    for run in earlier:
        folder = run.data.tags.get(FOLDER_TAG)
        is_of_grid = run.data.tags.get(PARENT_TAG) == job.grid.repeats
        if is_of_grid and run.info.status == "RUNNING" and folder is not None and Path(folder).is_dir():
            # Raises if the run is in progress, as after its launcher was killed: it would be trained twice.
            with folder_lock(Path(folder)):
                # Ends the run if its process has died.
                sync(Path(folder), lambda _: store)
            run = store.get_run(run.info.run_id)
        if run.info.status != "RUNNING" and folder is not None and (Path(folder) / LAST_CHECKPOINT).exists():
            _set_parent(store, run, job)
            # Trusted, because its configuration is this job's.
            return resume_run(store, run.info.run_id, job_label=job.label, trust=True)
    return run_experiment(config, invocation)


def earlier_runs(store: TrackingStore, experiment_id: str, sums: Mapping[str, str], job: Job) -> list[Run]:
    """Return the earlier runs of a job: first those of the repeated grid, and each time the latest first.

    Then come single runs, and jobs of grids with the same command line, such as an earlier repetition. Trials of
    studies and jobs of other grids are left out.

    Args:
        store: Store of the runs.
        experiment_id: ID of their MLflow experiment.
        sums: Checksums of the job's configuration and volumes, as tags.
        job: Job to repeat.
    """
    wanted = " and ".join(f"tags.`{tag}` = '{value}'" for tag, value in sums.items())
    found = store.search_runs([experiment_id], wanted, order_by=["attributes.start_time DESC"])
    parents = {run.info.run_id: run.data.tags.get(PARENT_TAG) for run in found if STUDY_TAG not in run.data.tags}
    known = [each for each in {*parents.values(), job.grid.run_id} if each is not None and each.isalnum()]
    grids = store.runs([experiment_id], f"attributes.run_id IN ({', '.join(map(repr, known))})")
    overrides = {grid.info.run_id: _overrides_of(grid) for grid in grids}
    kin = {grid for grid in overrides if overrides[grid] == overrides.get(job.grid.run_id)} | {job.grid.repeats, None}
    own = [run for run in found if run.info.run_id in parents and parents[run.info.run_id] in kin]
    return sorted(own, key=lambda run: parents[run.info.run_id] != job.grid.repeats)


def _check_volumes(
    store: TrackingStore, experiment_id: str, params: Mapping[str, str], now: Fingerprints, job: Job
) -> None:
    """Raise `ChangedVolumesError` if the repeated grid has a run on the same data whose volumes, in all, were others.

    The folds of a cross-validation have the same volumes, in other parts; another subject would be another fold.
    """
    assert job.grid.repeats is not None
    for run in store.children(experiment_id, job.grid.repeats):
        if _data_in(run.data.params) != _data_in(params):
            continue
        # A run that was killed at its start has no record of its volumes.
        with contextlib.suppress(TrackingError), TemporaryDirectory() as folder:
            if (then := load_run(store.uri, run.info.run_id).volumes(Path(folder))) is not None:
                check_unchanged({"grid's": _joined(then)}, {"grid's": _joined(now)}, f"run {run.info.run_id} of it had")
                return


def _data_in(params: Mapping[str, str]) -> dict[str, str]:
    return {key: value for key, value in params.items() if is_under(key, ("data",)) and key != FOLD}


def _joined(prints: Fingerprints) -> dict[str, str]:
    return {name: each for volumes in prints.values() for name, each in volumes.items()}


def _overrides_of(grid: Run) -> set[str]:
    """Return the overrides that repeat a grid, each once; empty for a run that is not a grid."""
    with contextlib.suppress(ArmscanError):
        return set(grid_overrides(grid))
    return set()


def _set_parent(store: TrackingStore, run: Run, job: Job) -> None:
    """Make a run a child of the grid that is repeated."""
    store.set_tag(run.info.run_id, PARENT_TAG, job.grid.run_id)
    store.set_tag(run.info.run_id, JOB_TAG, str(job.number))


def _metrics_of(run: Run) -> Metrics:
    return {
        name: figures.metrics() for name, figures in figures_of(run.data.metrics).items() if name != LAST_VALIDATION
    }

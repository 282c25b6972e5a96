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
from armscan.errors import TrackingError
from armscan.experiment.build import check_keys, set_up
from armscan.experiment.job import Invocation, Job
from armscan.experiment.provenance import provenance_files, sha256_tags
from armscan.experiment.results import LAST_VALIDATION, figures_of
from armscan.experiment.resume import check_own_code, resume_run
from armscan.experiment.runner import run_experiment
from armscan.tracking import TrackingStore, load_run, open_store, sync
from armscan.tracking.git import code_tags
from armscan.tracking.sanitize import params_of
from armscan.tracking.tags import CONTINUED_TAG, FOLDER_TAG, JOB_TAG, OWN_CODE_TAG, PARENT_TAG
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
    earlier = earlier_runs(store, experiment_id, sha256_tags(provenance_files(resolved, setup)), job, setup.own_code)
    if not any(PARENT_TAG in run.data.tags for run in earlier):
        _check_volumes(store, experiment_id, params_of(resolved), setup.fingerprints, job)
    for run in earlier:
        if PARENT_TAG in run.data.tags:
            check_own_code(run, setup)
    # Those of the grid first, of these the finished ones.
    for run in sorted(earlier, key=lambda run: (PARENT_TAG not in run.data.tags, run.info.status != "FINISHED")):
        if run.info.status == "FINISHED":
            print(f"[{job.label}] has finished before: run {run.info.run_id}", flush=True)
            _set_parent(store, run, job)
            return _metrics_of(run)
        if FOLDER_TAG not in run.data.tags:
            continue
        folder = Path(run.data.tags[FOLDER_TAG])
        if PARENT_TAG in run.data.tags and run.info.status == "RUNNING" and folder.is_dir():
            # Raises if the run is in progress, as after its launcher was killed: it would be trained twice.
            with folder_lock(folder):
                # Ends the run if its process has died.
                sync(folder, lambda _: store)
            run = store.get_run(run.info.run_id)
        if run.info.status != "RUNNING" and (folder / LAST_CHECKPOINT).exists():
            _set_parent(store, run, job)
            # Trusted, because its configuration is this job's.
            return resume_run(store, run.info.run_id, job_label=job.label, trust=True)
    return run_experiment(config, invocation)


def earlier_runs(
    store: TrackingStore, experiment_id: str, sums: Mapping[str, str], job: Job, own_code: Mapping[str, str]
) -> list[Run]:
    """Return the earlier runs of a job: first those of the repeated grid, and each time the latest first.

    The repeated grid may have continued others, whose jobs it had not come to. Then come single runs of the same code.

    Args:
        store: Store of the runs.
        experiment_id: ID of their MLflow experiment.
        sums: Checksums of the job's configuration and volumes, as tags.
        job: Job to repeat.
        own_code: Checksums of the modules of the user's own classes, by their names.
    """
    assert job.grid.repeats is not None
    grids, code = _with_continued(store, experiment_id, job.grid.repeats), code_tags()
    wanted = " and ".join(f"tags.`{tag}` = '{value}'" for tag, value in sums.items())
    own, alone = [], []
    for run in store.search_runs([experiment_id], wanted, order_by=["attributes.start_time DESC"]):
        tags = run.data.tags
        if tags.get(PARENT_TAG) in grids:
            own.append(run)
        elif PARENT_TAG not in tags and all(tags.get(name, "") == value for name, value in code.items()):
            alone += [] if changed_modules(tags.get(OWN_CODE_TAG), own_code) else [run]
    return own + alone


def _with_continued(store: TrackingStore, experiment_id: str, grid: str) -> set[str]:
    """Return the run IDs of a grid, and of those that it continues."""
    found, new = set[str](), [grid]
    while new:
        found.add(each := new.pop())
        before = store.search_runs([experiment_id], f"tags.`{CONTINUED_TAG}` = '{each}'")
        new += [run.info.run_id for run in before if run.info.run_id not in found]
    return found


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


def _set_parent(store: TrackingStore, run: Run, job: Job) -> None:
    """Make a run a child of the grid that is repeated."""
    store.set_tag(run.info.run_id, PARENT_TAG, job.grid.run_id)
    store.set_tag(run.info.run_id, JOB_TAG, str(job.number))


def _metrics_of(run: Run) -> Metrics:
    return {
        name: figures.metrics() for name, figures in figures_of(run.data.metrics).items() if name != LAST_VALIDATION
    }

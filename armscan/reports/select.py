"""Runs of a comparison: the named runs, and the trainings below them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mlflow.entities import Run

from armscan.errors import InvalidValueError, TrackingError, listed
from armscan.tracking import TrackingStore, check_version, find_run
from armscan.tracking.run import MAX_DEPTH
from armscan.tracking.store import store_errors
from armscan.tracking.tags import AGENT_TAG, EVALUATED_TAG, JOB_TAG

# Prefix that names a whole experiment of MLflow instead of a run.
EXPERIMENT = "experiment:"
N_SHOWN = 6


def read_runs(text: str) -> list[str]:
    """Return the names in `--runs`, each once, in order.

    Raises:
        InvalidValueError: If one of the names is empty.
    """
    named = [name.strip() for name in text.split(",")]
    if not all(name.removeprefix(EXPERIMENT) for name in named):
        raise InvalidValueError(
            f"--runs is {text!r}, but it must be IDs of runs, or {EXPERIMENT}NAME, with commas between"
        )
    return list(dict.fromkeys(named))


def find_trainings(store: TrackingStore, named: Sequence[str]) -> list[Run]:
    """Return the named trainings, each once: in the order of the names, then of their starts.

    Args:
        store: Store of the runs.
        named: IDs, or their first characters, of trainings or of their parents, or whole experiments; see `read_runs`.

    Raises:
        TrackingError: If one of them is not found, is an evaluation, or contains no training.
    """
    found: dict[str, Run] = {}
    with store_errors(store.uri):
        for name in named:
            trainings = _in_experiment(store, name) if name.startswith(EXPERIMENT) else _meant(store, name)
            found |= {run.info.run_id: run for run in trainings}
        for run in found.values():
            check_version(run)
        return list(found.values())


def _meant(store: TrackingStore, name: str) -> list[Run]:
    run = find_run(store, name)
    if EVALUATED_TAG in run.data.tags:
        raise TrackingError(
            f"run {run.info.run_id} is an evaluation, but runs are compared: name the run that it evaluates"
        )
    trainings = list(_below(store, run))
    if not trainings:
        raise TrackingError(
            f"run {run.info.run_id} ({run.info.run_name}) is not an armscan training, and has none below it"
        )
    return trainings


def _below(store: TrackingStore, run: Run, depth: int = 0) -> Iterator[Run]:
    """Yield a run if it is a training, else those of its jobs, trials and seeds."""
    if AGENT_TAG in run.data.tags:
        yield run
    elif depth <= MAX_DEPTH:
        children = store.children(run.info.experiment_id, run.info.run_id)
        # Jobs of a grid start in parallel: sorted by number, they are in the order of the grid's own table.
        numbers = {child.info.run_id: child.data.tags.get(JOB_TAG, "") for child in children}
        for child in sorted(children, key=lambda each: (len(numbers[each.info.run_id]), numbers[each.info.run_id])):
            yield from _below(store, child, depth + 1)


def _in_experiment(store: TrackingStore, name: str) -> list[Run]:
    wanted = name.removeprefix(EXPERIMENT)
    experiment = store.get_experiment_by_name(wanted)
    if experiment is None or experiment.lifecycle_stage != "active":
        names = [each.name for each in store.search_experiments(max_results=N_SHOWN)]
        there = f"only {listed(names)}" if names else "none at all"
        raise TrackingError(f"the experiment is {wanted!r}, but in {store.uri!r} there is {there}")
    trainings = [run for run in store.runs([experiment.experiment_id]) if AGENT_TAG in run.data.tags]
    if not trainings:
        raise TrackingError(f"the experiment is {wanted!r}, but in {store.uri!r} it has no armscan training")
    return trainings
